"""The kernels, usable alone: stateless functions over packed rows.

Every op runs on CPU (and CUDA where compiled), is deterministic, differentiable, and works under
``torch.compile(fullgraph=True)``. The same ops are ``torch.ops.gsim3d.*``.
"""

from gsim3d.ops._load import cuda_compiled
from gsim3d.ops.pool import pool_max, pool_mean, unpool
from gsim3d.ops.plane_sweep import plane_sweep, sweep_geometry

__all__ = ["cuda_compiled", "plane_sweep", "pool_max", "pool_mean", "sweep_geometry", "unpool"]
