"""gsim3d learns 3D simulators from multi-view video.

:class:`gsim3d.Simulator` is the learned simulator; the kernels (``gsim3d.rasterize_gaussians`` and the others of
``gsim3d.ops``) are usable alone. Names load on first use, so ``gsim3d._core`` (the kernels on numpy arrays) works
without torch.
"""

import importlib
from typing import Any

from gsim3d.errors import check_processor

__version__ = "0.2.0"

check_processor()

_HOME = {
    "gsim3d.cameras": ("Cameras", "FrameSource", "Frames", "InputSpec"),
    "gsim3d.effects.spec": ("EffectsSpec", "UnsupportedEffect"),
    "gsim3d.errors": ("GradientError", "InputError", "NumericalError", "ProcessorError"),
    "gsim3d.numerics.report": ("StabilityReport",),
    "gsim3d.presets": ("ModelConfig",),
    "gsim3d.profile.autotune": ("autotune",),
    "gsim3d.simulator": ("Prediction", "Simulator"),
    "gsim3d.state": ("Gaussians", "Particles"),
    "gsim3d.ops": (
        "CURVES",
        "KernelMap",
        "PatchTable",
        "Pyramid",
        "PyramidCapacity",
        "PyramidSpec",
        "Rendering",
        "Segments",
        "Stage",
        "Voxels",
        "add_cells",
        "build_pyramid",
        "cuda_compiled",
        "curve_encode",
        "curve_sort",
        "decode_gaussians",
        "find_cells",
        "joint_attention",
        "norm_gelu",
        "overlapping_patches",
        "patch_attention",
        "plane_sweep",
        "pool_max",
        "pool_mean",
        "rasterize_gaussians",
        "residual_norm",
        "row_norm",
        "row_scenes",
        "sparse_conv",
        "sweep_geometry",
        "unpool",
        "validate_state",
    ),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = ["__version__", *_MODULE_OF]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(importlib.import_module(_MODULE_OF[name]), name)
    raise AttributeError(f"module 'gsim3d' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
