"""gsim3d learns 3D simulators from multi-view video.

``gsim3d.ops`` holds the kernels, usable alone; :class:`gsim3d.Simulator` is the learned simulator. Names load on first
use, so ``gsim3d._core`` (the kernels on numpy arrays) works without torch.
"""

import importlib

from gsim3d.errors import check_processor

__version__ = "0.2.0"

check_processor()

_HOME = {
    "Cameras": "gsim3d.cameras",
    "EffectsSpec": "gsim3d.effects.spec",
    "Frames": "gsim3d.cameras",
    "Gaussians": "gsim3d.state",
    "GradientError": "gsim3d.errors",
    "NumericalError": "gsim3d.errors",
    "InputError": "gsim3d.errors",
    "Particles": "gsim3d.state",
    "ProcessorError": "gsim3d.errors",
    "Simulator": "gsim3d.simulator",
    "StabilityReport": "gsim3d.numerics.report",
    "autotune": "gsim3d.profile.autotune",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name):
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'gsim3d' has no attribute {name!r}")


def __dir__():
    return sorted(__all__)
