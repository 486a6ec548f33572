"""OBJ, STL, GLB and glTF: read through trimesh, and written."""

import contextlib
import json
import logging
import os
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from clsurf.errors import FileFormatError, InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

from ..surface.arrays import lengths_of
from .colors import as_rgba8
from .files import write_array
from .images import read_image, to_srgb8, write_image
from .rows import BLOCK, digits_of, world_of, write_rows

_NO_PICTURE = (2, 2)  # what trimesh puts where a material names no picture


def read_mesh(path: Path) -> Mesh | PointCloud:
    """Read a mesh with its vertices unmerged and in order; a scene's parts are placed and put together.

    A vertex of an OBJ file with several texture coordinates becomes one vertex for each (a seam). Only a picture that
    the file names is its texture: one of the same name beside it may be a rendering of it, ours among them.

    Raises
    ------
    FileFormatError
        Damaged, without vertices, or compressed with Draco while DracoPy is not installed.
    """
    ending = path.suffix.lower()
    if ending == ".stl":
        _check_stl(path)
    if ending in (".glb", ".gltf"):
        _check_draco(path)
    options = {}
    if ending == ".obj":
        data = path.read_bytes()
        # Without texture coordinates every vertex stays as it is; with them vertices are split along seams.
        options["maintain_order"] = b"\nvt" not in data
    with _quiet():
        loaded = trimesh.load(str(path), process=False, **options)
    parts = _placed_parts(loaded)
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if len(meshes) == 1:
        return _mesh_of(meshes[0], path)
    if meshes:
        return _mesh_of(trimesh.util.concatenate(meshes), path)
    clouds = [part for part in parts if len(getattr(part, "vertices", ())) and part.vertices.shape[1] == 3]
    if not clouds:
        raise FileFormatError(f"{path}: holds no vertices")
    points = np.concatenate([np.asarray(part.vertices, np.float64) for part in clouds])
    colors = [np.asarray(getattr(part, "colors", ())) for part in clouds]
    whole = all(c.ndim == 2 and len(c) == len(p.vertices) for c, p in zip(colors, clouds, strict=True))
    return PointCloud(points, colors=as_rgba8(np.concatenate(colors)) if whole else None)


def _placed_parts(loaded) -> list:
    """Return the geometries of a scene moved to their places; the vertices are float64 there."""
    if not isinstance(loaded, trimesh.Scene):
        return [loaded]
    parts = []
    for node in loaded.graph.nodes_geometry:
        matrix, name = loaded.graph[node]
        part = loaded.geometry[name]
        normals = _given_normals(part)
        if not np.array_equal(matrix, np.eye(4)):
            part = part.copy()
            part.apply_transform(matrix)
            if normals is not None:
                normals = normals @ np.linalg.inv(matrix[:3, :3])
        part.metadata["clsurf_normals"] = normals
        parts.append(part)
    return parts


def _given_normals(part) -> NDArray | None:
    """Return the normals that the file has; the property would compute them otherwise."""
    cache = getattr(part, "_cache", None)
    normals = None if cache is None else cache.cache.get("vertex_normals")
    return None if normals is None or np.shape(normals) != np.shape(part.vertices) else np.asarray(normals)


def _mesh_of(part: trimesh.Trimesh, path: Path) -> Mesh:
    count = len(part.vertices)
    points = np.asarray(part.vertices, np.float64)
    if path.suffix.lower() == ".stl" and np.abs(points).max(initial=0) < 3e38:
        points = points.astype(np.float32)
    faces = np.asarray(part.faces)
    if faces.min() < 0 or faces.max() >= count:
        raise FileFormatError(f"{path}: face index outside the {count:,} vertices: damaged file")
    normals = part.metadata.get("clsurf_normals", _given_normals(part))
    normals = None if normals is None or len(normals) != count else np.asarray(normals, np.float32)
    colors = uv = texture = None
    visual = part.visual
    if visual.kind == "vertex":
        colors = as_rgba8(visual.vertex_colors)
    elif visual.kind == "face":
        colors = as_rgba8(visual.to_vertex_colors().vertex_colors if hasattr(visual, "to_vertex_colors")
                          else trimesh.visual.color.face_to_vertex_color(part, visual.face_colors))
    elif visual.kind == "texture" and np.shape(getattr(visual, "uv", None)) == (count, 2):
        uv = np.asarray(visual.uv, np.float32)
        texture = _texture_of(visual.material)
    return Mesh(points, faces, normals, colors, uv, texture)


def _texture_of(material) -> NDArray | None:
    """Return the picture (h, w, 4) uint8 of a material, or None."""
    picture = getattr(material, "baseColorTexture", None)
    picture = getattr(material, "image", None) if picture is None else picture
    if picture is not None and picture.size != _NO_PICTURE:
        return np.array(picture.convert("RGBA"))
    return None


def with_texture(scan, picture, path) -> Mesh:
    """Return a mesh with a picture, a file or an array, as its texture; `path`: where the mesh came from."""
    if not isinstance(scan, Mesh) or scan.uv is None:
        raise InputError(f"texture: expected a mesh with texture coordinates, got {path}, which has none")
    pixels = picture if isinstance(picture, np.ndarray) else read_image(picture)
    if pixels.ndim != 3 or not 1 <= pixels.shape[2] <= 4 or pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError("texture: expected a picture (h, w, 1 to 4) of uint8, uint16 or float32, got "
                         f"{pixels.shape} {pixels.dtype}")
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257).astype(np.uint8)
    if pixels.shape[2] < 3:  # grey, and alpha
        pixels = np.concatenate([pixels[..., :1]] * 3 + [pixels[..., 1:]], axis=2)
    if pixels.dtype != np.uint8:
        pixels = to_srgb8(pixels)
    texture = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    texture[..., :pixels.shape[2]] = pixels
    return replace(scan, texture=texture)


def _check_stl(path: Path) -> None:
    """Refuse a binary STL file that is shorter or longer than its count of triangles says."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(512)
    if head.lstrip()[:5].lower() == b"solid" and b"facet" in head:
        return
    count = struct.unpack("<I", head[80:84])[0] if len(head) >= 84 else 0
    if size < 84 + 50 * count or not count:
        raise FileFormatError(f"{path}: truncated or not an STL file: {count:,} triangles do not fit in {size:,} bytes")


def _check_draco(path: Path) -> None:
    """Refuse Draco-compressed glTF without its decoder: trimesh would give zeros."""
    with open(path, "rb") as file:
        head = file.read(20)
        if head[:4] == b"glTF":
            length = struct.unpack("<I", head[12:16])[0]
            if length > path.stat().st_size:
                raise FileFormatError(f"{path}: truncated: its description is {length:,} bytes long")
            tree = json.loads(file.read(length))
        else:
            tree = json.loads(head + file.read())
    if "KHR_draco_mesh_compression" in tree.get("extensionsRequired", ()):
        try:
            import DracoPy  # noqa: F401
        except ImportError:
            raise FileFormatError(f"{path}: compressed with Draco, whose decoder is missing: "
                                  "pip install DracoPy") from None


@contextlib.contextmanager
def _quiet():
    """Hold back trimesh's own log lines: what matters of them is raised or logged here."""
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def write_mesh(scan: Mesh | PointCloud, path: Path) -> None:
    """Write .obj, .stl or .glb at `path`, the temporary name that `replacing` gave."""
    {".obj": _write_obj, ".stl": _write_stl, ".glb": _write_glb}[path.suffix.lower()](scan, path)


def _faces(scan) -> NDArray:
    return getattr(scan, "faces", np.zeros((0, 3), np.int32))


def _write_stl(scan: Mesh, path: Path) -> None:
    corners = (scan.vertices + scan.origin).astype(np.float32)[scan.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = lengths_of(normals, keepdims=True)
    rows = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    rows["normal"] = normals / np.where(length > 0, length, 1)
    rows["corners"] = corners
    with open(path, "wb") as file:
        file.write(b"clsurf".ljust(80, b" ") + struct.pack("<I", len(rows)))
        write_array(file, rows)


def _write_obj(scan, path: Path) -> None:
    """Write OBJ; colours follow the positions (a common extension), a texture goes to NAME.mtl and NAME.png."""
    faces, uv = _faces(scan), getattr(scan, "uv", None)
    texture = getattr(scan, "texture", None)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.write("# clsurf\n")
        if texture is not None and uv is not None:
            stem = _final_stem(path)
            file.write(f"mtllib {stem}.mtl\nusemtl {stem}\n")
            picture, material = path.with_name(f"{stem}.png"), path.with_name(f"{stem}.mtl")
            write_image(picture, texture)
            beside = path.with_suffix(".mtl")
            beside.write_text(f"newmtl {stem}\nKa 1 1 1\nKd 1 1 1\nmap_Kd {stem}.png\n", encoding="utf-8")
            os.replace(beside, material)
        colors = [] if scan.colors is None else [(scan.colors[:, :3] / 255, "%.6f")]
        write_rows(file, [(world_of(scan), digits_of(scan)), *colors], "v ")
        if uv is not None:
            write_rows(file, [(uv, "%.9g")], "vt ")
        if scan.normals is not None:
            write_rows(file, [(scan.normals, "%.9g")], "vn ")
        corner = {(False, False): "%d", (True, False): "%d/%d", (False, True): "%d//%d",
                  (True, True): "%d/%d/%d"}[uv is not None, scan.normals is not None]
        repeat = corner.count("%d")
        line = "f " + " ".join([corner] * 3) + "\n"
        for at in range(0, len(faces), BLOCK):
            block = np.repeat(faces[at:at + BLOCK] + 1, repeat, axis=1)
            file.write((line * len(block)) % tuple(block.ravel().tolist()))


def _write_glb(scan, path: Path) -> None:
    """Write GLB; the float64 origin is the translation of its node."""
    faces = _faces(scan)
    if len(faces):
        part = trimesh.Trimesh(scan.points, faces, vertex_normals=scan.normals, process=False)
        if getattr(scan, "uv", None) is not None and scan.texture is not None:
            from PIL import Image
            material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(scan.texture),
                                                           metallicFactor=0.0, roughnessFactor=1.0)
            part.visual = trimesh.visual.TextureVisuals(uv=scan.uv, material=material)
        elif scan.colors is not None:
            part.visual = trimesh.visual.ColorVisuals(part, vertex_colors=scan.colors)
    else:
        part = trimesh.PointCloud(scan.points, colors=scan.colors)
    scene = trimesh.Scene()
    placement = np.eye(4)
    placement[:3, 3] = scan.origin
    scene.add_geometry(part, transform=placement)
    with _quiet():
        data = scene.export(file_type="glb", include_normals=scan.normals is not None)
    path.write_bytes(data)


def _final_stem(path: Path) -> str:
    """Return the stem of the file that `replacing` made the temporary name `path` for: .STEM.RANDOM.ending."""
    return path.stem[1:].rsplit(".", 1)[0] if path.stem.startswith(".") else path.stem
