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
from .build.normals import estimate_normals
from .build.patches import build_patches
from .build.project import Projection, project
from .build.slim import build_slim
from .device import Device, Profile, open_device
from .errors import Error
from .io import load, load_frames, save
from .io.stored import StoredSurface
from .io.stored import open_surface as open
from .render.camera import Camera
from .render.frame import Frame
from .render.patch_drawing import PatchDrawing
from .render.renderer import Renderer, render
from .render.scene import Scene
from .render.shade import Light, Shading
from .render.slim_drawing import SlimDrawing
from .report.page import report
from .surface.cloud import PointCloud
from .surface.mesh import Mesh
from .surface.patch import PatchSurface
from .surface.placed import Placed
from .surface.ranges import RangeImage, RangeScan
from .surface.slim import SlimSurface
from .trace.hits import Hits, trace

__version__ = "0.1.0"

__all__ = [
    "Camera", "Curvature", "Device", "Error", "Frame", "Hits", "Light", "Lines", "Mesh", "PatchDrawing",
    "PatchSurface", "Placed", "PointCloud", "Profile", "Projection", "RangeImage", "RangeScan", "Renderer", "Scene",
    "Shading", "SlimDrawing", "SlimSurface", "StoredSurface", "SurfaceError", "build_patches", "build_slim",
    "color_map", "curvature", "error", "errors", "estimate_normals", "line_channels", "line_surface", "lines", "load",
    "load_frames", "models", "open", "open_device", "project", "render", "report", "save", "slim_of_error", "smooth",
    "sparsity", "trace",
]
