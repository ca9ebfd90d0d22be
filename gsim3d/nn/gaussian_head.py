"""Particles -> 3D Gaussians -> images."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d import ops
from gsim3d.cameras import Cameras
from gsim3d.compat.quirks import Quirks
from gsim3d.errors import InputError, check_ranges
from gsim3d.math.rotations import quat_product, rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import (
    degree_damping,
    lit,
    painted,
    published_axes,
    readings,
    rotate_harmonics,
    sh_basis,
    turn_predicted_harmonics,
)
from gsim3d.nn.layers import RowLinear, widened
from gsim3d.numerics.policy import OnInvalid, StabilityReport
from gsim3d.ops.raster import Rendering
from gsim3d.state import Gaussians, Particles

NEAR_PLANE = 0.01  # metres; what is nearer to a camera is not drawn
RELEASED_NEAR_SHARE = 0.2  # of the cameras' near bound
HARMONIC_14 = 1.445305721320277  # its factor


@dataclass(frozen=True)
class RendererConfig:
    """How particles become Gaussians.

    latents: channels of dynamic and static latents together; 0 for explicit particles, whose head has no weights.
    sh_degree: 0 to 3, of the view-dependent colour.
    scale_min, scale_max: metres, limits of predicted scales.
    initial_scale: metres, scale that an untrained head predicts; None: the middle of the limits.
    jacobian: "exact", or "clamped" of models that were trained so; as of :func:`gsim3d.ops.rasterize_gaussians`.
    quirks: published behaviour to imitate.
    """

    latents: int = 64
    sh_degree: int = 3
    scale_min: float = 0.0002
    scale_max: float = 0.1
    initial_scale: float | None = None
    jacobian: Literal["exact", "clamped"] = "exact"
    quirks: Quirks = field(default_factory=Quirks)

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
        hidden, K = F.gelu(self.fc1(particles.latents)), self.config.n_harmonics
        if n_harmonics == K:
            raw = self.fc2(hidden)
        else:
            wanted = [(c * K, c * K + n_harmonics) for c in range(3)] if n_harmonics else []
            raw = self.fc2.some(hidden, [*wanted, (3 * K, 3 * K + 7)])
        turns = particles.orientations
        if self.config.quirks == Quirks():
            wide = torch.float64 if raw.dtype == torch.float64 else torch.float32
            quats, scales, sh = ops.decode_gaussians(
                raw,
                readings(wide, raw.device),
                degree=math.isqrt(n_harmonics) - 1,
                scale_min=self.config.scale_min,
                scale_max=self.config.scale_max,
                check=False,
            )
            if turns is not None:
                quats = quat_product(turns, quats)
            if n_harmonics == 0:
                return None, quats, scales
            if turns is not None and n_harmonics > 1:  # the constant looks the same from everywhere
                sh = rotate_harmonics(sh, rotation_matrices(turns))
            return sh if particles.color_transform is None else painted(sh, particles.color_transform), quats, scales
        sh, quats, scales = widened(raw).split([raw.shape[1] - 7, 4, 3], 1)
        quats = unit_quats(quats.roll(1, 1))
        if turns is not None:
            quats = quat_product(turns, quats)
        smallest, largest = self.config.scale_min, self.config.scale_max
        scales = smallest + (largest - smallest) * scales.sigmoid()
        if n_harmonics == 0:
            return None, quats, scales
        sh = sh.unflatten(1, (3, -1)).mT * degree_damping(self.config.sh_degree, sh)[:n_harmonics, None]
        if n_harmonics > 1:
            sh = turn_predicted_harmonics(sh, rotation_matrices(quats), self.config.quirks)
        return sh if particles.color_transform is None else painted(sh, particles.color_transform), quats, scales


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor | None = None,
    *,
    near_plane: float = NEAR_PLANE,
    features: Tensor | None = None,
    cutoff: str = "exact",
    jacobian: str = "exact",
    on_invalid: OnInvalid = "raise",
    report: StabilityReport | None = None,
) -> Rendering:
    """Images of ``cameras``; camera i shows cloud ``cameras.image_cloud[i]`` of ``gaussians``.

    Arguments and errors as :func:`gsim3d.ops.rasterize_gaussians`. The colours of Gaussians without any mean nothing.
    """
    color = {"colors": gaussians.means} if gaussians.sh is None else {"sh": gaussians.sh}
    return ops.rasterize_gaussians(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        cameras,
        **color,
        features=features,
        background=background,
        cu_rows=gaussians.cu_rows,
        near_plane=near_plane,
        cutoff=cutoff,
        jacobian=jacobian,
        on_invalid=on_invalid,
        report=report,
    )


def render_as_published(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor | None = None,
    *,
    quirks: Quirks,
    jacobian: str = "clamped",
) -> Rendering:
    """:func:`render` with the quirks of the published renderer, image by image as there."""
    if len(cameras) == 0:
        return render(gaussians, cameras, background)
    images = []
    for i in range(len(cameras)):
        one = torch.tensor([i], device=cameras.near.device)
        camera = cameras.select(one, torch.zeros_like(one))
        camera = with_centered_principal_point(camera) if quirks.centered_principal_point else camera
        cloud = int(cameras.image_cloud[i])
        first, end = gaussians.cu_rows[cloud : cloud + 2].tolist()
        means, quats, scales, opacities, sh = (
            getattr(gaussians, name)[first:end] for name in ("means", "quats", "scales", "opacities", "sh")
        )
        color = {"colors": colors_with_z(sh, means, camera)} if quirks.z_in_harmonic_14 else {"sh": sh}
        images.append(
            ops.rasterize_gaussians(
                means,
                quats,
                scales,
                opacities,
                camera,
                **color,
                background=background if background is None or background.dim() == 1 else background[one],
                near_plane=RELEASED_NEAR_SHARE * float(camera.near) if quirks.far_near_plane else NEAR_PLANE,
                cutoff="tile3sigma" if quirks.three_sigma_tiles else "exact",
                jacobian=jacobian,
            )
        )
    color, alpha, depth = (
        torch.cat([getattr(image, name) for image in images]) for name in ("color", "alpha", "depth")
    )
    return Rendering(color, alpha, depth, None)


def with_centered_principal_point(cameras: Cameras) -> Cameras:
    """Cameras of the same opening angles, measured through the middles of opposite edges, with a centred view."""
    size = cameras.Ks.new_tensor([cameras.width, cameras.height], dtype=torch.float64)
    middle = torch.tensor([[[0, 0.5], [1, 0.5]], [[0.5, 0], [0.5, 1]]], dtype=torch.float64, device=size.device) * size
    pixels = F.pad(middle, (0, 1), value=1.0)  # [axis, edge, 3]
    rays = F.normalize(torch.einsum("iab,xeb->ixea", torch.linalg.inv(cameras.Ks.double()), pixels), dim=-1)
    cosine = (rays[:, :, 0] * rays[:, :, 1]).sum(-1)
    focal = size / (2 * ((1 - cosine) / (1 + cosine)).sqrt())
    Ks = torch.diag_embed(F.pad(focal, (0, 1), value=1.0))
    Ks[:, :2, 2] = size / 2
    return dataclasses.replace(cameras, Ks=Ks.to(cameras.Ks))


def colors_with_z(sh: Tensor, means: Tensor, camera: Cameras) -> Tensor:
    """[N, 3] colours of ``sh`` [N, K, 3] seen by one camera, harmonic 14 as published; its gradient is the true one."""
    pose = torch.linalg.inv(camera.viewmats[0].double())[:3, 3].to(means)
    directions = F.normalize(means - pose, dim=1)
    colors = torch.einsum("nk,nkc->nc", sh_basis(directions, math.isqrt(sh.shape[1]) - 1), sh) + 0.5
    if sh.shape[1] == 16:
        axes = published_axes(sh)
        x, y, z = directions.detach().unbind(1)
        weight = HARMONIC_14 * (z - y) * (z * z - x * x)
        colors = colors + weight[:, None] * rotate_harmonics(sh.detach(), axes.expand(sh.shape[0], 3, 3))[:, 14]
    return colors.clamp(min=0)
