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
        # Points alone where there are no faces.
        faces = getattr(mesh, "faces", np.arange(len(mesh.points))[:, None])
        cells_of = np.concatenate([np.full((len(faces), 1), faces.shape[1]), faces], axis=1).astype(np.int64)
        points, cells, data = module.vtkPoints(), module.vtkCellArray(), module.vtkPolyData()
        points.SetData(numpy_to_vtk(np.array(mesh.points), deep=True))
        cells.SetCells(len(faces), numpy_to_vtkIdTypeArray(cells_of.ravel(), deep=True))
        data.SetPoints(points)
        (data.SetPolys if faces.shape[1] == 3 else data.SetVerts)(cells)
        if mesh.normals is not None:
            data.GetPointData().SetNormals(numpy_to_vtk(np.array(mesh.normals), deep=True))
        if mesh.colors is not None:
            data.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(mesh.colors[:, :3]), deep=True))
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


def apss(mesh, resolution: int = 200) -> dict | None:
    """Return MeshLab's APSS surface of the scan's points: seconds, RMS of the points to it (world units), vertices.

    Its projection filter crashes in pymeshlab 2025.7 on any mesh, so its marching cubes stand for it, on a grid of
    `resolution` cells along the longest side. None after a line where MeshLab is not installed or fails.
    """
    try:
        import pymeshlab
    except (ImportError, OSError):
        print("peer MeshLab: not installed (pip install clsurf[bench])")
        return None
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=np.asarray(mesh.vertices, np.float64),
                                   face_matrix=np.asarray(mesh.faces, np.int32)))
    meshes.compute_normal_per_vertex()
    try:
        start = time.perf_counter()
        meshes.generate_marching_cubes_apss(resolution=resolution)
        seconds = time.perf_counter() - start
        made = meshes.current_mesh_id()
        distances = meshes.get_hausdorff_distance(sampledmesh=0, targetmesh=made, samplevert=True, sampleedge=False,
                                                  sampleface=False, samplenum=len(mesh.vertices))
    except pymeshlab.PyMeshLabException as error:
        print(f"peer MeshLab: not measured ({error})")
        return None
    return {"seconds": seconds, "rms": distances["RMS"], "vertices": meshes.mesh(made).vertex_number()}
