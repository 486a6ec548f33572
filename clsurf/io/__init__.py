"""Files: scans, surfaces and pictures in and out."""

from .dispatch import load as load
from .dispatch import save as save
