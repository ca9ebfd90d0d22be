"""gsim3d learns 3D simulators from multi-view video.

:class:`gsim3d.Simulator` is the learned simulator; the kernels of ``gsim3d.ops``, such as
``gsim3d.rasterize_gaussians``, can be used on their own. Names are imported on first use, so that ``gsim3d._core`` (the
kernels on numpy arrays) works without torch.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

from gsim3d.errors import check_processor

__version__ = "0.2.0"

check_processor()

_HOME = {
    "gsim3d.cameras": "Cameras FrameSource Frames InputSpec",
    "gsim3d.effects.spec": "EffectsSpec UnsupportedEffect",
    "gsim3d.errors": "GradientError InputError NumericalError ProcessorError",
    "gsim3d.numerics.report": "StabilityReport",
    "gsim3d.presets": "ModelConfig",
    "gsim3d.profile.autotune": "autotune",
    "gsim3d.simulator": "Prediction Simulator",
    "gsim3d.state": "Actions Gaussians Particles",
    "gsim3d.ops": """
        CURVES KernelMap PartialRecord PatchTable Projection Pyramid PyramidCapacity PyramidSpec Rendering Segments
        SpringLists Stage ValidatedState Voxels add_cells advance_springs build_pyramid cuda_compiled curve_encode
        curve_sort decode_gaussians find_cells join_records joint_attention norm_gelu overlapping_patches
        patch_attention plane_sweep pool_max pool_mean project_gaussians rasterize_gaussians rasterize_projected
        residual_norm row_norm row_scenes sh_to_color segment_min segment_softmax segment_sum sparse_conv
        sweep_geometry unpool validate_state
    """,
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names.split()}

__all__ = ["__version__", *_MODULE_OF]

if TYPE_CHECKING:  # the same names for type checkers; tests/test_types.py compares them
    from gsim3d.cameras import Cameras as Cameras, Frames as Frames, FrameSource as FrameSource, InputSpec as InputSpec
    from gsim3d.effects.spec import EffectsSpec as EffectsSpec, UnsupportedEffect as UnsupportedEffect
    from gsim3d.errors import (
        GradientError as GradientError,
        InputError as InputError,
        NumericalError as NumericalError,
        ProcessorError as ProcessorError,
    )
    from gsim3d.numerics.report import StabilityReport as StabilityReport
    from gsim3d.ops import *  # noqa: F403
    from gsim3d.presets import ModelConfig as ModelConfig
    from gsim3d.profile.autotune import autotune as autotune
    from gsim3d.simulator import Prediction as Prediction, Simulator as Simulator
    from gsim3d.state import Actions as Actions, Gaussians as Gaussians, Particles as Particles


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(importlib.import_module(_MODULE_OF[name]), name)
    raise AttributeError(f"module 'gsim3d' has no attribute {name!r}", name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    return sorted(__all__)
