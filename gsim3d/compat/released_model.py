"""The published model as subclasses of gsim3d's modules, which reproduce the behaviour its weights were trained with.

Each override reproduces one behaviour of the release that :mod:`gsim3d` corrects; see docs/compat/differences.md for
the others. :func:`as_released` changes the classes of the modules of a network, so that names of weights stay the same.
"""

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, TypeVar

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
from gsim3d.nn.multiview_encoder.crops import Crops
from gsim3d.nn.multiview_encoder.depth import CostVolume, Depth, DepthPredictor, Views
from gsim3d.nn.multiview_encoder.heads import ParticleHeads, PixelParticles, PixelRays, unit_vectors
from gsim3d.nn.multiview_encoder.transformer import MultiViewTransformer
from gsim3d.numerics.policy import LARGEST
from gsim3d.ops.raster import Rendering
from gsim3d.presets import ModelConfig
from gsim3d.simulator import Simulator
from gsim3d.state import Gaussians

HALF_MAX = torch.finfo(torch.float16).max  # larger values overflow in float16 and give NaN in attention
NEAR_SHARE = 0.2  # near plane of the rasterizer, as a fraction of a camera's near bound
HARMONIC_14 = 1.445305721320277  # normalisation factor of harmonic 14

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True, kw_only=True)
class ReleasedDynamicsConfig(DynamicsConfig):
    """Dynamics configuration of the release.

    The grid origin and the depth of curves depend on all clouds of a call, so that clouds influence each other; time
    slots count from the first step; opacities have no upper limit; frozen particles keep their position, but not their
    orientation (with one step per call).
    """

    origin_of_scene: ClassVar[bool] = False
    slots_from_newest: ClassVar[bool] = False
    max_opacity: ClassVar[float] = LARGEST

    def __post_init__(self):
        super().__post_init__()
        if self.background != "symmetric" or self.priors:
            raise ValueError('ReleasedDynamicsConfig: background must be "symmetric", and there must be no priors')

    @property
    def frozen_turn(self) -> bool:
        return self.steps_per_call == 1


@dataclass(frozen=True)
class ReleasedModelConfig(ModelConfig):
    """Model configuration of the release.

    Attributes:
        dynamics: dynamics configuration of the release.
        release: True; marks the configuration in a checkpoint.
    """

    dynamics: ReleasedDynamicsConfig = field(default_factory=ReleasedDynamicsConfig)
    release: bool = True


class ReleasedTransformer(MultiViewTransformer):
    """With three or more views, the mask of shifted windows is tiled by view although keys are ordered by position, so
    it masks the wrong keys."""

    masks_by_label = False

    def cross_mask(self, mask: Tensor, n_views: int) -> Tensor:
        view = torch.arange(n_views, device=mask.device)
        position = torch.arange(mask.shape[1], device=mask.device)
        other = (view[:, None] + view[1:]) % n_views
        rank = other - (other > view[:, None]).long()  # index of a key view among the other views of a query view
        column = (position * (n_views - 1) + rank[..., None]) % len(position)  # [V, V - 1, L]
        return mask[:, :, column].permute(2, 0, 1, 3, 4).flatten(3)


class ReleasedCostVolume(CostVolume):
    """Feature pixel 0 is at image coordinate 0 instead of at its centre, and the plane sweep projects into source views
    with the intrinsics of the reference view."""

    def feature_intrinsics(self, Ks: Tensor) -> Tensor:
        scaled = super().feature_intrinsics(Ks)
        scaled[:, :2, 2] = Ks[:, :2, 2] / self.factor + 0.5
        return scaled

    def source_intrinsics(self, Ks: Tensor, src_images: Tensor, n_views: int) -> Tensor:
        return Ks.repeat_interleave(n_views - 1, 0)


class ReleasedDepthPredictor(DepthPredictor):
    """Coarse disparity and features are upsampled with aligned corners."""

    def upsampling_stride(self, n: int) -> float:
        return (self.factor * n - 1) / max(1, n - 1)


class ReleasedHeads(ParticleHeads):
    """Particles are placed at depth along the ray, although the plane sweep predicts z; Pluecker moments are about the
    world origin; harmonics are rotated by :func:`rotate_released_harmonics`."""

    def forward(self, depth: Depth, views: Views, origin: Tensor, crops: Crops | None = None) -> PixelParticles:
        return super().forward(depth, views, torch.zeros_like(origin), crops)

    def _rays(self, geometry: PixelRays, raw_offset: Tensor, corners: Tensor | None = None) -> Tensor:
        return unit_vectors(super()._rays(geometry, raw_offset, corners))

    def rotate_harmonics(self, sh: Tensor, rotations: Tensor) -> Tensor:
        return rotate_released_harmonics(sh, rotations)


class ReleasedSparseConv(point_transformer.SparseConv):
    """A convolution reads the first row of a cell with several rows, instead of their mean."""

    duplicates = "first"


class ReleasedAttention(point_transformer.Attention):
    """Queries, keys, values and results are rounded to float16, clamped to its range (the release overflows)."""

    def forward(self, x: Tensor, patches: ops.PatchTable, row: int = 0, beside=None) -> Tensor:
        q, k, v = rounded_to_half(self.qkv(x)).unflatten(1, (3, self.heads, -1)).unbind(1)
        return self.proj(rounded_to_half(ops.patch_attention(q, k, v, patches, check=False).flatten(1)))


class ReleasedDecoderStage(point_transformer.DecoderStage):
    """The first convolution reads the skip branch before the upsampled features are added."""

    def conv_input(self, x: Tensor, skip: Tensor) -> Tensor:
        return skip


class ReleasedHead(GaussianHead):
    """Predicted harmonics are rotated by the predicted rotation, see :func:`rotate_released_harmonics`."""

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


_OF_ENCODER = ReleasedTransformer, ReleasedCostVolume, ReleasedDepthPredictor, ReleasedHeads
_OTHERS = ReleasedSparseConv, ReleasedAttention, ReleasedDecoderStage, ReleasedHead
COUNTERPARTS = {released.__base__: released for released in (*_OF_ENCODER, *_OTHERS)}


def as_released(network: Module, without: Collection[type] = ()) -> Module:
    """Changes the classes of the modules of ``network`` to those of this file, except classes in ``without``."""
    for module in network.modules():
        released = COUNTERPARTS.get(type(module))
        if released is not None and released not in without:
            module.__class__ = released
    return network


class ReleasedSimulator(Simulator):
    """A :class:`Simulator` that reproduces the predictions of the published model."""

    config_class = ReleasedModelConfig
    draws_in_graphs = False

    def __init__(self, config: ReleasedModelConfig):
        super().__init__(config)
        as_released(self)

    def plan(self, spec: EffectsSpec | None = None) -> Plan:
        spec = self.effects if spec is None else spec
        if spec.outputs.features or not spec.outputs.rgb:
            raise UnsupportedEffect("unsupported effect outputs: the published renderer renders colours, no features")
        return super().plan(spec)

    def _rasterized(self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None, **options) -> Rendering:
        return render_released(gaussians, cameras, background, jacobian=options["jacobian"])


def load_released(path: str | Path, *, device: str = "cpu") -> ReleasedSimulator:
    """Loads a checkpoint of ``gsim3d import``.

    Args:
        path: folder or .safetensors file.
        device: "cpu" or "cuda".

    Returns:
        The simulator in evaluation mode.

    Raises:
        InputError: as :meth:`gsim3d.Simulator.from_pretrained`.
    """
    return ReleasedSimulator.from_pretrained(path, device=device)


def simulator_class(config: ModelConfig) -> type[Simulator]:
    """Returns the simulator class for ``config``."""
    return ReleasedSimulator if isinstance(config, ReleasedModelConfig) else Simulator


def rounded_to_half(x: Tensor) -> Tensor:
    wide = widened(x).clamp(-HALF_MAX, HALF_MAX)  # widened, because bfloat16 would round the bound up
    # Straight-through gradients: rounding them to float16 could overflow.
    return (wide + (wide.half().to(wide) - wide).detach()).to(x.dtype)


def render_released(
    gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None, *, jacobian: str = "clamped"
) -> Rendering:
    """Renders images one by one as the published renderer does.

    Gaussians are cut off at the tiles of their three-sigma square, and culled nearer than a fifth of the camera's near
    bound; cameras keep their field of view, but the principal point is centred; colours are those of
    :func:`released_colors`.
    """
    images = []
    for i in range(len(cameras)):
        one = torch.tensor([i], device=cameras.near.device)
        camera = with_centered_principal_point(cameras.select(one, torch.zeros_like(one)))
        cloud = int(cameras.image_cloud[i])
        first, end = gaussians.cu_rows[cloud : cloud + 2].tolist()
        *rows, sh = (getattr(gaussians, name)[first:end] for name in ("means", "quats", "scales", "opacities", "sh"))
        behind = background if background is None or background.dim() == 1 else background[one]
        options = {"near_plane": NEAR_SHARE * float(camera.near), "cutoff": "tile3sigma", "jacobian": jacobian}
        colors = released_colors(sh, rows[0], camera)
        images.append(ops.rasterize_gaussians(*rows, camera, colors=colors, background=behind, **options))
    if not images:
        empty = gaussians.means.new_empty(0, cameras.height, cameras.width)
        return Rendering(empty.new_empty(*empty.shape, 3), empty, empty, None)
    return Rendering(*(torch.cat([getattr(image, name) for image in images]) for name in Rendering._fields[:3]), None)


def with_centered_principal_point(cameras: Cameras) -> Cameras:
    """Returns cameras with equal fields of view, measured between edge midpoints, and centred principal points."""
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
    """Evaluates colours [N, 3] of ``sh`` [N, K, 3] for one camera.

    As in the release, the value of harmonic 14 uses z instead of y (published axes), but its gradient is the true one.
    """
    pose = torch.linalg.inv(camera.viewmats[0].double())[:3, 3].to(means)
    directions = F.normalize(means - pose, dim=1)
    colors = torch.einsum("nk,nkc->nc", sh_basis(directions, math.isqrt(sh.shape[1]) - 1), sh) + 0.5
    if sh.shape[1] == 16:
        axes = published_axes(sh)
        x, y, z = directions.detach().unbind(1)
        weight = HARMONIC_14 * (z - y) * (z * z - x * x)
        colors = colors + weight[:, None] * rotate_harmonics(sh.detach(), axes.expand(sh.shape[0], 3, 3))[:, 14]
    return colors.clamp(min=0)
