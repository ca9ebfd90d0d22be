"""The published model: this one, but for what its weights were trained with.

Each override below is one line of the release that :mod:`gsim3d` corrects; docs/compat/differences.md has the rest.
:func:`as_released` gives the parts of a network the classes of this file, so that names of weights stay.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d import ops
from gsim3d.cameras import Cameras
from gsim3d.compat.released_harmonics import published_axes, rotate_released_harmonics
from gsim3d.dynamics import DynamicsConfig
from gsim3d.effects.plan import Plan
from gsim3d.effects.spec import EffectsSpec, UnsupportedEffect
from gsim3d.math.rotations import rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import degree_damping, rotate_harmonics, sh_basis
from gsim3d.nn import point_transformer
from gsim3d.nn.gaussian_head import GaussianHead
from gsim3d.nn.layers import widened
from gsim3d.nn.multiview_encoder.depth import CostVolume, Depth, DepthPredictor, Views
from gsim3d.nn.multiview_encoder.heads import ParticleHeads, PixelParticles, PixelRays, unit_vectors
from gsim3d.nn.multiview_encoder.transformer import MultiViewTransformer
from gsim3d.numerics.policy import LARGEST
from gsim3d.ops.raster import Rendering
from gsim3d.presets import ModelConfig
from gsim3d.simulator import Simulator
from gsim3d.state import Gaussians

HALF_MAX = torch.finfo(torch.float16).max  # beyond it half precision has infinity, and attention NaN
NEAR_SHARE = 0.2  # of a camera's near bound: what is nearer is not drawn
HARMONIC_14 = 1.445305721320277  # its factor

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True, kw_only=True)
class ReleasedDynamicsConfig(DynamicsConfig):
    """Cells are counted from the smallest position of a call and curves are as deep as its clouds are large, so clouds
    change each other; time slots count from the first step; opacities have no upper limit; frozen particles keep their
    place but not their orientation (with one step a call)."""

    def __post_init__(self):
        super().__post_init__()
        if self.background != "symmetric" or self.priors:
            raise ValueError('ReleasedDynamicsConfig: background must be "symmetric", and nothing beside the network')

    @property
    def origin_of_scene(self) -> bool:
        return False

    @property
    def slots_from_newest(self) -> bool:
        return False

    @property
    def max_opacity(self) -> float:
        return LARGEST

    @property
    def frozen_turn(self) -> bool:
        return self.steps_per_call == 1


@dataclass(frozen=True)
class ReleasedModelConfig(ModelConfig):
    """Sizes of the model of the published release.

    Attributes:
        release: True; a checkpoint's configuration says so by this key.
    """

    dynamics: ReleasedDynamicsConfig = field(default_factory=ReleasedDynamicsConfig)
    release: bool = True


class ReleasedTransformer(MultiViewTransformer):
    """With three or more views the mask of shifted windows is repeated along keys that are ordered position by
    position, so it hides the wrong ones."""

    def cross_mask(self, mask: Tensor, n_views: int) -> Tensor:
        view = torch.arange(n_views, device=mask.device)
        position = torch.arange(mask.shape[1], device=mask.device)
        other = (view[:, None] + view[1:]) % n_views
        rank = other - (other > view[:, None]).long()  # of a key view among the others of a query view
        column = (position * (n_views - 1) + rank[..., None]) % len(position)  # [V, V - 1, L]
        return mask[:, :, column].permute(2, 0, 1, 3, 4).flatten(3)


class ReleasedCostVolume(CostVolume):
    """Feature pixel 0 lies at pixel coordinate 0 instead of its centre, and the plane sweep projects into a source view
    with the intrinsics of the reference view."""

    def feature_intrinsics(self, Ks: Tensor) -> Tensor:
        scaled = super().feature_intrinsics(Ks)
        scaled[:, :2, 2] = Ks[:, :2, 2] / self.factor + 0.5
        return scaled

    def source_intrinsics(self, Ks: Tensor, src_images: Tensor, n_views: int) -> Tensor:
        return Ks.repeat_interleave(n_views - 1, 0)


class ReleasedDepthPredictor(DepthPredictor):
    """Coarse disparity and features are stretched from corner to corner."""

    def upsampling_stride(self, n: int) -> float:
        return (self.factor * n - 1) / max(1, n - 1)


class ReleasedHeads(ParticleHeads):
    """Depth means distance along the ray when particles are placed (the plane sweep means z); moments of viewing rays
    are taken about the world's origin; harmonics turn as :func:`rotate_released_harmonics`."""

    def forward(self, depth: Depth, views: Views, origin: Tensor) -> PixelParticles:
        return super().forward(depth, views, torch.zeros_like(origin))

    def _rays(self, geometry: PixelRays, raw_offset: Tensor) -> Tensor:
        return unit_vectors(super()._rays(geometry, raw_offset))

    def rotate_harmonics(self, sh: Tensor, rotations: Tensor) -> Tensor:
        return rotate_released_harmonics(sh, rotations)


class ReleasedSparseConv(point_transformer.SparseConv):
    """Where rows share a cell, a convolution reads the lowest row of a neighbour cell, not the mean."""

    duplicates = "first"


class ReleasedAttention(point_transformer.Attention):
    """Queries, keys, values and results are rounded to half precision (beyond its range to its largest number, where
    the release has infinity)."""

    def forward(self, x: Tensor, patches: ops.PatchTable, row: int = 0, beside=None) -> Tensor:
        q, k, v = rounded_to_half(self.qkv(x)).unflatten(1, (3, self.heads, -1)).unbind(1)
        return self.proj(rounded_to_half(ops.patch_attention(q, k, v, patches, check=False).flatten(1)))


class ReleasedDecoderStage(point_transformer.DecoderStage):
    """The first convolution reads the skip branch before the features from below are added to it."""

    def conv_input(self, x: Tensor, skip: Tensor) -> Tensor:
        return skip


class ReleasedHead(GaussianHead):
    """Predicted harmonics turn with the predicted rotation, as :func:`rotate_released_harmonics`."""

    def _decoded(self, raw: Tensor, turns: None, n_harmonics: int) -> tuple[Tensor | None, Tensor, Tensor]:
        sh, quats, scales = widened(raw).split([raw.shape[1] - 7, 4, 3], 1)
        quats = unit_quats(quats.roll(1, 1))
        smallest, largest = self.config.scale_min, self.config.scale_max
        scales = smallest + (largest - smallest) * scales.sigmoid()
        if n_harmonics == 0:
            return None, quats, scales
        sh = sh.unflatten(1, (3, -1)).mT * degree_damping(self.config.sh_degree, sh)[:n_harmonics, None]
        if n_harmonics > 1:
            sh = rotate_released_harmonics(sh, rotation_matrices(quats))
        return sh, quats, scales


COUNTERPARTS = {
    released.__base__: released
    for released in (
        ReleasedTransformer,
        ReleasedCostVolume,
        ReleasedDepthPredictor,
        ReleasedHeads,
        ReleasedSparseConv,
        ReleasedAttention,
        ReleasedDecoderStage,
        ReleasedHead,
    )
}


def as_released(network: Module, without: Collection[type] = ()) -> Module:
    """``network``, whose modules have become those of this file; ``without``: but for these classes."""
    for module in network.modules():
        released = COUNTERPARTS.get(type(module))
        if released is not None and released not in without:
            module.__class__ = released
    return network


class ReleasedSimulator(Simulator):
    """A :class:`Simulator` that predicts what the published model predicts with the same weights."""

    config_class = ReleasedModelConfig
    draws_in_graphs = False

    def __init__(self, config: ReleasedModelConfig):
        super().__init__(config)
        as_released(self)

    def plan(self, spec: EffectsSpec | None = None) -> Plan:
        spec = self.effects if spec is None else spec
        if spec.outputs.features or not spec.outputs.rgb:
            raise UnsupportedEffect(
                "unsupported effect outputs: the published renderer draws colour and no features; leave it out"
            )
        return super().plan(spec)

    def _rasterized(self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None, **options) -> Rendering:
        return render_released(gaussians, cameras, background, jacobian=options["jacobian"])


def load_released(path: str | Path, *, device: str = "cpu") -> ReleasedSimulator:
    """The simulator of a checkpoint that ``gsim3d import`` wrote.

    Args:
        path: its folder or .safetensors file.
        device: "cpu" or "cuda".
    Returns:
        The simulator, in evaluation mode.
    Raises:
        InputError: as :meth:`gsim3d.Simulator.from_pretrained`.
    """
    return ReleasedSimulator.from_pretrained(path, device=device)


def simulator_class(config: ModelConfig) -> type[Simulator]:
    """The class of the simulator that ``config`` describes."""
    return ReleasedSimulator if isinstance(config, ReleasedModelConfig) else Simulator


def rounded_to_half(x: Tensor) -> Tensor:
    wide = widened(x).clamp(-HALF_MAX, HALF_MAX)  # bfloat16 would round the bound up
    # Gradients are not rounded: those beyond the range would become infinite.
    return (wide + (wide.half().to(wide) - wide).detach()).to(x.dtype)


def render_released(
    gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None, *, jacobian: str = "clamped"
) -> Rendering:
    """Images as the published renderer draws them, one by one.

    A Gaussian ends at the tiles that its three-sigma square touches; Gaussians nearer than a fifth of the camera's near
    bound are culled; cameras keep their opening angles but look through the image's centre; colours are those of
    :func:`released_colors`.
    """
    images = []
    for i in range(len(cameras)):
        one = torch.tensor([i], device=cameras.near.device)
        camera = with_centered_principal_point(cameras.select(one, torch.zeros_like(one)))
        cloud = int(cameras.image_cloud[i])
        first, end = gaussians.cu_rows[cloud : cloud + 2].tolist()
        means, quats, scales, opacities, sh = (
            getattr(gaussians, name)[first:end] for name in ("means", "quats", "scales", "opacities", "sh")
        )
        images.append(
            ops.rasterize_gaussians(
                means,
                quats,
                scales,
                opacities,
                camera,
                colors=released_colors(sh, means, camera),
                background=background if background is None or background.dim() == 1 else background[one],
                near_plane=NEAR_SHARE * float(camera.near),
                cutoff="tile3sigma",
                jacobian=jacobian,
            )
        )
    if not images:
        empty = gaussians.means.new_empty(0, cameras.height, cameras.width)
        return Rendering(empty.new_empty(*empty.shape, 3), empty, empty, None)
    return Rendering(*(torch.cat([getattr(image, name) for image in images]) for name in Rendering._fields[:3]), None)


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


def released_colors(sh: Tensor, means: Tensor, camera: Cameras) -> Tensor:
    """[N, 3] colours of ``sh`` [N, K, 3] seen by one camera. The value of harmonic 14 has z where the harmonic has y
    (published axes); its gradient is the true one."""
    pose = torch.linalg.inv(camera.viewmats[0].double())[:3, 3].to(means)
    directions = F.normalize(means - pose, dim=1)
    colors = torch.einsum("nk,nkc->nc", sh_basis(directions, math.isqrt(sh.shape[1]) - 1), sh) + 0.5
    if sh.shape[1] == 16:
        axes = published_axes(sh)
        x, y, z = directions.detach().unbind(1)
        weight = HARMONIC_14 * (z - y) * (z * z - x * x)
        colors = colors + weight[:, None] * rotate_harmonics(sh.detach(), axes.expand(sh.shape[0], 3, 3))[:, 14]
    return colors.clamp(min=0)
