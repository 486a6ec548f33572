"""Files: scans, surfaces and pictures in and out."""

from .dispatch import load as load
from .dispatch import save as save
from .ranges import load_frames as load_frames
