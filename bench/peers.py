"""Other programs on the same scene in the same run, where they are installed (`pip install clsurf[bench]`)."""

import time

import numpy as np


def open3d():
    """Return the module Open3D, or None where it is not installed or does not load."""
    try:
        import open3d
    except (ImportError, OSError):
        return None
    return open3d


class EmbreeCaster:
    """Open3D's ray casting (Embree) of a mesh: the rays of a picture are made before, only the casting is timed."""

    name = "Open3D ray casting"

    def __init__(self, module, mesh):
        self.module, self.origin = module, mesh.origin
        self.scene = module.t.geometry.RaycastingScene()
        self.scene.add_triangles(module.core.Tensor(np.array(mesh.vertices)),
                                 module.core.Tensor(np.array(mesh.faces).astype(np.uint32)))

    def seconds(self, camera, size) -> float:
        """Return how long casting the picture's rays took."""
        origins, directions = camera.rays(size)
        rays = self.module.core.Tensor(np.concatenate([origins - self.origin, directions], axis=1).astype(np.float32))
        start = time.perf_counter()
        self.scene.cast_rays(rays)
        return time.perf_counter() - start


class VtkWindow:
    """VTK's rasteriser off screen, with the colour and depth buffers read back."""

    name = "VTK off screen"

    def __init__(self, module, mesh, size):
        self.module = module
        from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
        faces = np.concatenate([np.full((len(mesh.faces), 1), 3), mesh.faces], axis=1).astype(np.int64)
        points, cells, data = module.vtkPoints(), module.vtkCellArray(), module.vtkPolyData()
        points.SetData(numpy_to_vtk(np.array(mesh.vertices), deep=True))
        cells.SetCells(len(mesh.faces), numpy_to_vtkIdTypeArray(faces.ravel(), deep=True))
        data.SetPoints(points)
        data.SetPolys(cells)
        if mesh.normals is not None:
            data.GetPointData().SetNormals(numpy_to_vtk(np.array(mesh.normals), deep=True))
        mapper, actor, self.renderer = module.vtkPolyDataMapper(), module.vtkActor(), module.vtkRenderer()
        mapper.SetInputData(data)
        actor.SetMapper(mapper)
        self.renderer.AddActor(actor)
        self.window = module.vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetSize(*size)
        self.window.AddRenderer(self.renderer)
        self.size, self.origin = size, mesh.origin
        self.colour, self.depth = module.vtkUnsignedCharArray(), module.vtkFloatArray()

    def seconds(self, camera, size) -> float:
        """Return how long drawing and reading back took."""
        view = self.renderer.GetActiveCamera()
        eye = camera.eye - self.origin
        view.SetPosition(*eye)
        view.SetFocalPoint(*(eye - camera.rotation[2]))
        view.SetViewUp(*camera.rotation[1])
        view.SetViewAngle(camera.fov)
        self.renderer.ResetCameraClippingRange()
        width, height = self.size
        start = time.perf_counter()
        self.window.Render()
        self.window.GetRGBACharPixelData(0, 0, width - 1, height - 1, 0, self.colour)
        self.window.GetZbufferData(0, 0, width - 1, height - 1, self.depth)
        return time.perf_counter() - start

    def close(self) -> None:
        """Give the window's memory back."""
        self.window.Finalize()


def embree(mesh) -> EmbreeCaster | None:
    """Return Open3D's caster of `mesh`, or None after a line that says why not."""
    module = open3d()
    if module is None:
        print("peer Open3D: not installed (pip install clsurf[bench])")
        return None
    return EmbreeCaster(module, mesh)


def vtk_window(mesh, size) -> VtkWindow | None:
    """Return a VTK window that draws `mesh`, or None after a line that says why not."""
    try:
        import vtk
        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)  # it warns about a missing X server
        window = VtkWindow(vtk, mesh, size)
        window.window.Render()
    except (ImportError, OSError, RuntimeError) as error:
        print(f"peer VTK: not measured ({error})")
        return None
    return window


def apss(mesh) -> dict | None:
    """Return MeshLab's APSS on the scan's own points: seconds, and the root mean square of how far it moved them.

    The distances are comparable with those of the points to a SLIM surface: both say how far a smooth surface made
    from the points lies from them. World units. None after a line where MeshLab is not installed.
    """
    try:
        import pymeshlab
    except (ImportError, OSError):
        print("peer MeshLab: not installed (pip install clsurf[bench])")
        return None
    meshes = pymeshlab.MeshSet(verbose=False)
    points = np.asarray(mesh.vertices, np.float64)
    for _ in range(2):  # the surface's own mesh, and the copy whose vertices are projected
        meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, face_matrix=np.asarray(mesh.faces, np.int32),
                                       v_normals_matrix=np.asarray(mesh.normals, np.float64)))
    start = time.perf_counter()
    meshes.compute_mls_projection_apss(controlmesh=0, proxymesh=1)
    seconds = time.perf_counter() - start
    moved = np.linalg.norm(meshes.mesh(1).vertex_matrix() - points, axis=1)
    good = np.isfinite(moved)
    return {"seconds": seconds, "rms": float(np.sqrt(np.mean(moved[good] ** 2))), "lost": int((~good).sum())}
