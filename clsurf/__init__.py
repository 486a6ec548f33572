"""clsurf: compact surface models from scans, drawn, traced, measured and cleaned on any OpenCL device.

The public names on one screen; every other name is private to the package.
"""

from . import interrupt  # noqa: F401, I001  first: the other imports take a second
from . import errors, models
from .analysis.color_maps import color_map
from .analysis.curvature import Curvature, curvature
from .analysis.error import SurfaceError, error
from .analysis.line_strokes import Lines
from .analysis.line_surface import line_surface
from .analysis.lines import line_channels, lines
from .analysis.smooth import smooth
from .analysis.sparsity import slim_of_error, sparsity
from .build.morph import morph
from .build.normals import estimate_normals
from .build.patches import build_patches
from .build.project import Projection, project
from .build.scale_map import build_scale_map
from .build.slim import build_slim
from .build.surfels import build_surfels
from .build.to_mesh import to_mesh
from .build.to_points import to_points
from .device import Device, Profile, open_device
from .errors import Error
from .io import load, load_frames, save
from .io.stored import StoredSurface, open_surface
from .io.video import write_video
from .render.camera import Camera
from .render.camera_path import CameraPath, load_cameras, render_frames, save_cameras, turntable
from .render.frame import Frame
from .render.light import Light
from .render.material import Material
from .render.patch_drawing import PatchDrawing
from .render.point_drawing import PointDrawing
from .render.renderer import Renderer, render
from .render.scale_map_drawing import ScaleMapDrawing
from .render.scene import Scene
from .render.shade import Shading
from .render.slim_drawing import SlimDrawing
from .render.surfel_drawing import SurfelDrawing
from .report.page import report
from .surface.cloud import PointCloud
from .surface.mesh import Mesh
from .surface.patch import PatchSurface
from .surface.placed import Placed
from .surface.ranges import RangeImage, RangeScan
from .surface.scale_map import ScaleMap
from .surface.slim import SlimSurface
from .surface.surfel import SurfelHierarchy
from .trace.hits import trace
from .trace.rays import Hits
from .view.canvas import view
from .view.viewer import Viewer

__version__ = "0.1.0"

__all__ = [
    "Camera", "CameraPath", "Curvature", "Device", "Error", "Frame", "Hits", "Light", "Lines", "Material", "Mesh",
    "PatchDrawing", "PatchSurface", "Placed", "PointCloud", "PointDrawing", "Profile", "Projection", "RangeImage",
    "RangeScan", "Renderer", "ScaleMap", "ScaleMapDrawing", "Scene", "Shading", "SlimDrawing", "SlimSurface",
    "StoredSurface", "SurfaceError", "SurfelDrawing", "SurfelHierarchy", "Viewer", "build_patches", "build_scale_map",
    "build_slim", "build_surfels", "color_map", "curvature", "error", "errors", "estimate_normals", "line_channels",
    "line_surface", "lines", "load", "load_cameras", "load_frames", "models", "morph", "open_device", "open_surface",
    "project", "render", "render_frames", "report", "save", "save_cameras", "slim_of_error", "smooth", "sparsity",
    "to_mesh", "to_points", "trace", "turntable", "view", "write_video",
]
