"""The kernels, usable alone: stateless functions over packed rows.

Every op runs on CPU (and CUDA where compiled), is deterministic, differentiable, and works under
``torch.compile(fullgraph=True)``. The same ops are ``torch.ops.gsim3d.*``.
"""

from gsim3d.ops._load import cuda_compiled
from gsim3d.ops.background import add_cells, find_cells, overlapping_patches, row_scenes
from gsim3d.ops.curve import (
    CURVES,
    KernelMap,
    PatchTable,
    Pyramid,
    PyramidCapacity,
    PyramidSpec,
    Segments,
    Stage,
    Voxels,
    build_pyramid,
    curve_encode,
    curve_sort,
)
from gsim3d.ops.decode import decode_gaussians
from gsim3d.ops.patch_attn import joint_attention, patch_attention
from gsim3d.ops.plane_sweep import plane_sweep, sweep_geometry
from gsim3d.ops.pool import pool_max, pool_mean, unpool
from gsim3d.ops.projection import Projection, project_gaussians, sh_to_color
from gsim3d.ops.raster import Rendering, rasterize_gaussians
from gsim3d.ops.raster_projected import rasterize_projected
from gsim3d.ops.row_norm import norm_gelu, residual_norm, row_norm
from gsim3d.ops.segment import segment_min, segment_softmax, segment_sum
from gsim3d.ops.sparse_conv import sparse_conv
from gsim3d.ops.springs import SpringLists, advance_springs
from gsim3d.ops.validate_state import PartialRecord, ValidatedState, join_records, validate_state

__all__ = [
    "CURVES",
    "KernelMap",
    "PartialRecord",
    "PatchTable",
    "Projection",
    "Pyramid",
    "PyramidCapacity",
    "PyramidSpec",
    "Rendering",
    "Segments",
    "SpringLists",
    "Stage",
    "ValidatedState",
    "Voxels",
    "add_cells",
    "advance_springs",
    "build_pyramid",
    "cuda_compiled",
    "curve_encode",
    "curve_sort",
    "decode_gaussians",
    "find_cells",
    "join_records",
    "joint_attention",
    "norm_gelu",
    "overlapping_patches",
    "patch_attention",
    "plane_sweep",
    "pool_max",
    "pool_mean",
    "project_gaussians",
    "rasterize_gaussians",
    "rasterize_projected",
    "residual_norm",
    "row_norm",
    "row_scenes",
    "sh_to_color",
    "segment_min",
    "segment_softmax",
    "segment_sum",
    "sparse_conv",
    "sweep_geometry",
    "unpool",
    "validate_state",
]
