"""Compatibility with checkpoints of the authors' release and of earlier versions of gsim3d."""


def __getattr__(name):
    if name == "load_released":
        from gsim3d.compat.released_model import load_released

        return load_released
    raise AttributeError(f"module 'gsim3d.compat' has no attribute {name!r}")
