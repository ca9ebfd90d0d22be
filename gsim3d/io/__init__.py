"""Files: splat formats by suffix (``read_splats``, ``write_splats``), .ply, video, and safe reading and writing."""

import importlib

_HOME = {
    "FORMATS": "formats",
    "format_of": "formats",
    "read_particles": "particles",
    "read_ply": "ply",
    "read_splats": "formats",
    "write_particles": "particles",
    "write_ply": "ply",
    "write_splats": "formats",
    "write_video": "video",
}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        return getattr(importlib.import_module(f"gsim3d.io.{_HOME[name]}"), name)
    raise AttributeError(f"module 'gsim3d.io' has no attribute {name!r}")
