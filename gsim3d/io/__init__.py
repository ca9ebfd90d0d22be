"""Files: splat formats by suffix (``read_splats``, ``write_splats``), .ply, video, and safe reading and writing."""

import importlib

_HOME = dict.fromkeys(("FORMATS", "format_of", "read_splats", "write_splats"), "formats")
_HOME |= {"read_ply": "ply", "write_ply": "ply", "write_video": "video"}
_HOME |= dict.fromkeys(("read_particles", "write_particles"), "particles")

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        return getattr(importlib.import_module(f"gsim3d.io.{_HOME[name]}"), name)
    raise AttributeError(f"module 'gsim3d.io' has no attribute {name!r}")
