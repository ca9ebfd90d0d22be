"""Particles -> 3D Gaussians -> images."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.cameras import Cameras
from gsim3d.errors import InputError, check_ranges
from gsim3d.math.rotations import quat_product, rotation_matrices
from gsim3d.math.spherical_harmonics import lit, painted, readings, rotate_harmonics
from gsim3d.nn.layers import RowLinear
from gsim3d.ops.raster import Rendering
from gsim3d.state import Gaussians, Particles

NEAR_PLANE = 0.01  # metres; what is nearer to a camera is not drawn


@dataclass(frozen=True)
class RendererConfig:
    """How particles become Gaussians."""

    #: channels of dynamic and static latents together; 0 for explicit particles, whose head has no weights
    latents: int = 64
    sh_degree: int = 3  #: 0 to 3, of the view-dependent colour
    scale_min: float = 0.0002  #: metres, lower limit of predicted scales
    scale_max: float = 0.1  #: metres, upper limit
    initial_scale: float | None = None  #: metres, scale that an untrained head predicts; None: the middle of the limits
    #: "exact", or "clamped" of models that were trained so; see :func:`gsim3d.ops.rasterize_gaussians`
    jacobian: Literal["exact", "clamped"] = "exact"

    def __post_init__(self):
        check_ranges(self, latents=(0, 10**5), sh_degree=(0, 3), scale_max=(1e-6, 1e6), scale_min=(0, self.scale_max))
        if self.initial_scale is not None and not self.scale_min < self.initial_scale < self.scale_max:
            raise InputError(f"initial_scale must be between scale_min and scale_max; got {self.initial_scale}")

    @property
    def n_harmonics(self) -> int:
        return (self.sh_degree + 1) ** 2


class GaussianHead(nn.Module):
    """Rotation, scale and colour of each particle from its latents; position and opacity are the particle's own.

    Channels of the last layer: harmonics (3, K), rotation (x, y, z, w), scale (3). Colours are predicted in the
    particle's frame and turn with it.
    """

    def __init__(self, config: RendererConfig):
        super().__init__()
        self.config = config
        if config.latents == 0:
            return
        hidden, n_out = 4 * config.latents, 3 * config.n_harmonics + 4 + 3
        self.fc1 = RowLinear(config.latents, hidden)
        self.fc2 = RowLinear(hidden, n_out)
        with torch.no_grad():
            self.fc2.bias.zero_()
            self.fc2.bias[-4] = 1.0  # the identity rotation
            if config.initial_scale is not None:
                share = (config.initial_scale - config.scale_min) / (config.scale_max - config.scale_min)
                self.fc2.bias[-3:] = math.log(share / (1 - share))

    def forward(self, particles: Particles, *, sh_degree: int | None = None, rgb: bool = True) -> Gaussians:
        """The Gaussians of all rows; ``sh_degree``: without colours of higher degrees; not ``rgb``: without any."""
        n_harmonics = (self.config.n_harmonics if sh_degree is None else (sh_degree + 1) ** 2) if rgb else 0
        sh, quats, scales = self._shape_and_color(particles, n_harmonics)
        if sh is not None and particles.irradiance_gain is not None:
            sh = lit(sh, particles.irradiance_gain)
        offset = None if particles.world_offset is None else particles.world_offset[particles.cloud_scene]
        return Gaussians(particles.means, quats, scales, particles.opacities, sh, particles.cu_rows, offset)

    def _shape_and_color(self, particles: Particles, n_harmonics: int) -> tuple[Tensor | None, Tensor, Tensor]:
        if self.config.latents == 0:
            return particles.sh[:, :n_harmonics] if n_harmonics else None, particles.quats, particles.scales
        hidden, K = self.fc1(particles.latents, gelu=True), self.config.n_harmonics
        if n_harmonics == K:
            raw = self.fc2(hidden)
        else:
            wanted = [(c * K, c * K + n_harmonics) for c in range(3)] if n_harmonics else []
            raw = self.fc2.some(hidden, [*wanted, (3 * K, 3 * K + 7)])
        sh, quats, scales = self._decoded(raw, particles.orientations, n_harmonics)
        if sh is not None and particles.color_transform is not None:
            sh = painted(sh, particles.color_transform)
        return sh, quats, scales

    def _decoded(self, raw: Tensor, turns: Tensor | None, n_harmonics: int) -> tuple[Tensor | None, Tensor, Tensor]:
        """Harmonics, unit quaternions and scales of the channels ``raw``, turned further by ``turns``."""
        table = readings(torch.float64 if raw.dtype == torch.float64 else torch.float32, raw.device)
        limits = {"scale_min": self.config.scale_min, "scale_max": self.config.scale_max}
        degree = math.isqrt(n_harmonics) - 1
        quats, scales, sh = ops.decode_gaussians(raw, table, degree=degree, **limits, check=False)
        if turns is not None:
            quats = quat_product(turns, quats)
        if n_harmonics == 0:
            return None, quats, scales
        if turns is not None and n_harmonics > 1:  # the constant looks the same from everywhere
            sh = rotate_harmonics(sh, rotation_matrices(turns))
        return sh, quats, scales


def render(gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None, **options: Any) -> Rendering:
    """Images of ``cameras``; camera i shows cloud ``cameras.image_cloud[i]`` of ``gaussians``.

    Arguments and errors as :func:`gsim3d.ops.rasterize_gaussians`. The colours of Gaussians without any mean nothing.
    """
    rows = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    options = {"near_plane": NEAR_PLANE, **options}
    options |= {"colors": gaussians.means} if gaussians.sh is None else {"sh": gaussians.sh}
    return ops.rasterize_gaussians(*rows, cameras, background=background, cu_rows=gaussians.cu_rows, **options)
