"""Conversion of state dicts between the published model and gsim3d.

Besides names, two things differ: gsim3d predicts all latents with one convolution, and stores spherical harmonics of
explicit particles in the standard basis, so the first and last layer of the dynamics absorb a change of basis.
"""

import re

import torch
from torch import Tensor

from gsim3d.compat.released_harmonics import published_axes
from gsim3d.dynamics.step import StateLayout
from gsim3d.math.spherical_harmonics import rotate_harmonics
from gsim3d.nn.point_transformer_v3 import OF_BLOCK
from gsim3d.presets import ModelConfig

ENCODER, DYNAMICS, HEAD = "encoder.", "dynamic_model.net.", "decoder."  # name prefixes of the published model
_COUNTER = "num_batches_tracked"  # unused buffer of batch norms

# (published, ours) prefixes; # stands for a number. The first matching pair applies, in either direction.
_DYNAMICS = [
    ("embedding.stem", "stem"),
    ("enc.enc#.down.proj", "encoder.#.pool.proj"),
    ("enc.enc#.down.norm.0", "encoder.#.pool.norm"),
    ("enc.enc#.merger.pos_emb", "encoder.#.merge.time_embedding"),
    ("dec.dec#.up.proj.0", "decoder.#.unpool.proj"),
    ("dec.dec#.up.proj.1", "decoder.#.unpool.proj_norm"),
    ("dec.dec#.up.proj_skip.0", "decoder.#.unpool.skip"),
    ("dec.dec#.up.proj_skip.1", "decoder.#.unpool.skip_norm"),
    *((f"enc.enc#.block#.{theirs}", f"encoder.#.blocks.#.{ours}") for ours, theirs in OF_BLOCK.items()),
    *((f"dec.dec#.block#.{theirs}", f"decoder.#.blocks.#.{ours}") for ours, theirs in OF_BLOCK.items()),
    ("dec.{head}.norm_pre", "head.norm"),
    ("dec.{head}", "head"),
]
_ENCODER = [
    *((f"backbone.backbone.layer{i + 1}.#.downsample.0", f"cnn.stages.{i}.#.downsample") for i in range(3)),
    *((f"backbone.backbone.layer{i + 1}", f"cnn.stages.{i}") for i in range(3)),
    ("backbone.backbone", "cnn"),
    ("backbone.transformer", "transformer"),
    ("depth_predictor.corr_refine_net.0", "depth.cost_volume.refine_in.0"),
    ("depth_predictor.corr_refine_net.1", "depth.cost_volume.refine_in.1"),
    ("depth_predictor.corr_refine_net.3", "depth.cost_volume.unet"),
    ("depth_predictor.corr_refine_net.4", "depth.cost_volume.refine_out"),
    ("depth_predictor.regressor_residual", "depth.cost_volume.residual"),
    ("depth_predictor.depth_head_lowres", "depth.cost_volume.head"),
    ("depth_predictor.upsampler.0", "depth.upsampler"),
    ("depth_predictor.proj_feature", "depth.proj_feature"),
    ("depth_predictor.refine_unet.0", "depth.refine_in.0"),
    ("depth_predictor.refine_unet.1", "depth.refine_in.1"),
    ("depth_predictor.refine_unet.3", "depth.refine_unet"),
    ("depth_predictor.to_disparity", "depth.to_disparity"),
    ("depth_predictor.to_gaussians", "heads.to_gaussians"),
    ("depth_predictor.global_cond", "heads.conditioning.net"),
]
_HEAD = [("to_missing_3dgs.0", "fc1"), ("to_missing_3dgs.2", "fc2")]
LATENTS = [f"depth_predictor.to_mono_features.{kind}_latent_features." for kind in ("dynamic", "static")]


def _rename(name: str, pairs: list[tuple[str, str]], head: str = "#") -> str:
    """Replaces the prefix of ``name`` by the first matching pair; returns it unchanged if no pair matches."""
    for before, after in pairs:
        pattern = re.escape(before.format(head=head)).replace(r"\#", r"(\d+)")
        if match := re.match(rf"{pattern}(?=\.|$)", name):
            numbers = iter(match.groups())
            after = re.sub("#", lambda _: next(numbers), after.format(head=head))
            return after + name[match.end() :]
    return name


def _reversed(pairs: list[tuple[str, str]]) -> list[tuple[str, str]]:
    return [(ours, theirs) for theirs, ours in pairs]


def encoder_weights(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """Converts the weights below "encoder." to :class:`gsim3d.nn.multiview_encoder.Encoder`."""
    weights = {
        _rename(name, _ENCODER): value for name, value in published.items() if not name.startswith(tuple(LATENTS))
    }
    for kind in ("weight", "bias"):
        parts = [published[prefix + kind] for prefix in LATENTS if prefix + kind in published]
        if parts:
            weights[f"heads.to_latents.{kind}"] = torch.cat(parts)
    return weights


def dynamics_weights(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """Converts the weights below "dynamic_model.net." to :class:`gsim3d.nn.point_transformer.PointTransformer`."""
    return {_rename(name, _DYNAMICS): value for name, value in published.items() if not name.endswith(_COUNTER)}


def head_weights(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """Converts the weights below "decoder." to :class:`gsim3d.nn.gaussian_head.GaussianHead`."""
    weights = {_rename(name, _HEAD): value for name, value in published.items()}
    return weights | {"fc2.bias": torch.zeros_like(weights["fc2.weight"][:, 0])}


def from_published(published: dict[str, Tensor], config: ModelConfig) -> dict[str, Tensor]:
    """Converts a state dict of the published model to :class:`gsim3d.Simulator`; all names must be known."""
    parts = {part: _below(published, part) for part in (ENCODER, DYNAMICS, HEAD)}
    weights = {f"encoder.{name}": value for name, value in encoder_weights(parts[ENCODER]).items()}
    weights |= {f"dynamics.net.{name}": value for name, value in dynamics_weights(parts[DYNAMICS]).items()}
    if config.encoder.explicit:
        return _change_basis(weights, config, harmonics_matrix(config.encoder.sh_degree))
    return weights | {f"renderer.{name}": value for name, value in head_weights(parts[HEAD]).items()}


def to_published(weights: dict[str, Tensor], config: ModelConfig) -> dict[str, Tensor]:
    """Inverse of :func:`from_published`. The published head has no bias in its last layer: a nonzero one is dropped."""
    if config.encoder.explicit:
        weights = _change_basis(dict(weights), config, harmonics_matrix(config.encoder.sh_degree).T)
    published = {}
    for name, value in _below(weights, "encoder.").items():
        if name.startswith("heads.to_latents."):
            sizes = [config.encoder.dynamic_dim, config.encoder.static_dim]
            parts = zip(LATENTS, value.split(sizes), strict=True)
            published |= {ENCODER + prefix + name.rsplit(".", 1)[1]: part for prefix, part in parts if len(part)}
        else:
            published[ENCODER + _rename(name, _reversed(_ENCODER))] = value
    head = str(config.dynamics.n_stages - 1)
    for name, value in _below(weights, "dynamics.net.").items():
        name = DYNAMICS + _rename(name, _reversed(_DYNAMICS), head)
        published[name] = value
        if name.endswith("running_mean"):
            counter = torch.zeros((), dtype=torch.int64, device=value.device)
            published[name.replace("running_mean", _COUNTER)] = counter
    for name, value in _below(weights, "renderer.").items():
        if name != "fc2.bias":
            published[HEAD + _rename(name, _reversed(_HEAD))] = value
    return published


def harmonics_matrix(degree: int) -> Tensor:
    """Returns the orthogonal matrix, float64 [K, K], from published to standard harmonic coefficients.

    The published basis is the standard one evaluated at (z, x, y) instead of (x, y, z).
    """
    each = torch.eye((degree + 1) ** 2, dtype=torch.float64)
    return rotate_harmonics(each[None], published_axes(each).T[None])[0]


def _change_basis(weights: dict[str, Tensor], config: ModelConfig, matrix: Tensor) -> dict[str, Tensor]:
    """Changes the basis of harmonics in the weights of the dynamics by ``matrix``."""
    layout = StateLayout.of(config.dynamics)
    wide = torch.block_diag(*[matrix] * 3)  # for channels (3, K)
    of_head = layout.outputs, 0, config.dynamics.steps_per_call
    places = {"stem.conv.weight": (layout.inputs, -1, 1), "head.fc2.weight": of_head, "head.fc2.bias": of_head}
    for name, (fields, axis, repeats) in places.items():
        names, widths = zip(*fields, strict=True)
        index = names.index("sh")
        after = weights[f"dynamics.net.{name}"].clone()
        for start in range(sum(widths[:index]), repeats * sum(widths), sum(widths)):
            part = after.narrow(axis, start, widths[index]).movedim(axis, -1)
            part.copy_(part.double() @ wide.T.to(part.device))
        weights[f"dynamics.net.{name}"] = after
    return weights


def _below(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}
