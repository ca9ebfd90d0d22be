"""Particles -> 3D Gaussians -> images."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d import ops
from gsim3d.harmonics import degree_damping, rotate_harmonics, rotate_unpaired_harmonics
from gsim3d.layers import RowLinear
from gsim3d.ops.raster import Rendering
from gsim3d.quirks import Quirks
from gsim3d.types import Cameras, Gaussians, Particles

NEAR_PLANE = 0.01  # metres; what is nearer to a camera is not drawn
RELEASED_NEAR_SHARE = 0.2  # of the cameras' near bound
MIN_QUAT_NORM = 1e-6  # a shorter quaternion has no direction worth a gradient


@dataclass(frozen=True)
class RendererConfig:
    """How particles become Gaussians.

    latents: channels of dynamic and static latents together; 0 for explicit particles, whose head has no weights.
    sh_degree: 0 to 3, of the view-dependent colour.
    scale_min, scale_max: metres, limits of predicted scales.
    initial_scale: metres, scale that an untrained head predicts; None: the middle of the limits.
    quirks: published behaviour to imitate.
    """

    latents: int = 64
    sh_degree: int = 3
    scale_min: float = 0.0002
    scale_max: float = 0.1
    initial_scale: float | None = None
    quirks: Quirks = field(default_factory=Quirks)

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

    def forward(self, particles: Particles, *, sh_degree: int | None = None) -> Gaussians:
        """The Gaussians of all rows; ``sh_degree``: leave out colours of higher degrees."""
        n_harmonics = self.config.n_harmonics if sh_degree is None else (sh_degree + 1) ** 2
        sh, quats, scales = self._shape_and_color(particles, n_harmonics)
        return Gaussians(particles.means, quats, scales, particles.opacities, sh, particles.cu_rows)

    def _shape_and_color(self, particles: Particles, n_harmonics: int) -> tuple[Tensor, Tensor, Tensor]:
        if self.config.latents == 0:
            return particles.sh[:, :n_harmonics], particles.quats, particles.scales
        latents = torch.cat([particles.dynamic_latents, particles.static_latents], 1)
        raw = self.fc2(F.gelu(self.fc1(latents)))
        sh, quats, scales = raw.split([raw.shape[1] - 7, 4, 3], 1)
        quats = unit_quats(quats.roll(1, 1))
        smallest, largest = self.config.scale_min, self.config.scale_max
        scales = smallest + (largest - smallest) * scales.sigmoid()
        damping = degree_damping(self.config.sh_degree, sh)[:n_harmonics, None]
        sh = sh.unflatten(1, (3, -1))[:, :, :n_harmonics].mT * damping
        rotate = rotate_unpaired_harmonics if self.config.quirks.released_head_harmonics else rotate_harmonics
        return rotate(sh, rotation_matrices(quats)), quats, scales


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor | None = None,
    *,
    near_plane: float = NEAR_PLANE,
    cutoff: str = "exact",
) -> Rendering:
    """Images of ``cameras``; camera i shows cloud ``cameras.image_cloud[i]`` of ``gaussians``.

    Arguments and errors as :func:`gsim3d.ops.rasterize_gaussians`.
    """
    return ops.rasterize_gaussians(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        cameras,
        sh=gaussians.sh,
        background=background,
        cu_rows=gaussians.cu_rows,
        near_plane=near_plane,
        cutoff=cutoff,
    )


def release_options(cameras: Cameras, quirks: Quirks) -> dict[str, float | str]:
    """Keyword arguments with which :func:`render` draws as the published model's renderer does."""
    options: dict[str, float | str] = {}
    if quirks.far_near_plane:
        options["near_plane"] = RELEASED_NEAR_SHARE * float(cameras.near.max())
    if quirks.three_sigma_tiles:
        options["cutoff"] = "tile3sigma"
    return options


def unit_quats(quats: Tensor) -> Tensor:
    """[N, 4] normalised; the identity, without a gradient, where shorter than 1e-6."""
    short = quats.detach().norm(dim=1, keepdim=True) < MIN_QUAT_NORM
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    quats = torch.where(short, identity, quats)
    return quats / quats.norm(dim=1, keepdim=True)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Unit quaternions [N, 4] (w, x, y, z) -> [N, 3, 3]."""
    w, x, y, z = quats.unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).unflatten(1, (3, 3))
