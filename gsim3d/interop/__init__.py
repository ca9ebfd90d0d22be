"""Other formats: 3DGS .ply files and video."""

from gsim3d.interop.ply import read_ply, write_ply
from gsim3d.interop.video import write_video

__all__ = ["read_ply", "write_ply", "write_video"]
