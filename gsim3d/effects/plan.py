"""From what a scene calls for to what is computed: which effects are kept, which are skipped and why, and the cost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gsim3d.compat.quirks import Quirks
from gsim3d.dynamics.config import BLOCK_KERNEL, STEM_KERNEL, DynamicsConfig
from gsim3d.effects.spec import EffectsSpec, UnsupportedEffect
from gsim3d.presets import ModelConfig

# Of a surface in a grid, a convolution of K^3 taps finds about K^2 neighbours; a coarser grid keeps 1 / stride^2 rows.
SURFACE = 2
SPLATS_A_PIXEL = 30  # that are blended where there is a surface; multiply-adds of each, and of projecting a Gaussian
BLENDING, PROJECTION = 12, 250
BLENDED = "nothing: the one pass blends it in any case"


@dataclass(frozen=True)
class PlannedEffect:
    """One effect of a plan.

    kept: whether it is computed.   why: it is kept or not.
    takes: modules, kernels and buffers that only this effect needs: not called and not made where it is not kept.
    """

    name: str
    kept: bool
    why: str
    takes: str


@dataclass(frozen=True)
class Plan:
    """How a simulator will meet a spec.

    history: steps kept.   sh_degree: of rendered colours.   effects: every effect there is, kept or skipped.
    unused: parameters of the model that no kept effect reads, by name; a checkpoint need not have them.
    """

    spec: EffectsSpec
    history: int
    sh_degree: int
    effects: tuple[PlannedEffect, ...]
    unused: tuple[str, ...] = ()

    @property
    def kept(self) -> tuple[str, ...]:
        """Effects that are computed."""
        return tuple(effect.name for effect in self.effects if effect.kept)

    @property
    def skipped(self) -> dict[str, str]:
        """Effects that are not -> why."""
        return {effect.name: effect.why for effect in self.effects if not effect.kept}


@dataclass(frozen=True)
class Workload:
    """What a plan is applied to: particles of one step, moving and frozen, and images of it of so many pixels."""

    moving: int
    frozen: int
    views: int = 1
    pixels: int = 64 * 64


def make_plan(spec: EffectsSpec, model: ModelConfig) -> Plan:
    """The plan of a model.

    Raises:
        UnsupportedEffect: the model, or this version, cannot simulate an effect of ``spec``.
    """
    _check_supported(spec, model)
    dynamics, appearance, outputs = spec.dynamics, spec.appearance, spec.outputs
    history = _up_to("dynamics.history", dynamics.history, 2**model.dynamics.history_bits)
    sh_degree = _up_to("appearance.view_dependent", appearance.view_dependent, model.renderer.sh_degree)
    predicts_opacity = model.dynamics.explicit
    background, structure = dynamics.background, spec.structure
    rows = [
        ("time merging", history > 1, f"{history} steps of history", "a history of one step has nothing to merge",
         "time indices, their products with time embeddings"),
        ("frozen background", background in ("frozen", "asymmetric"), "particles marked frozen are seen, and stay",
         f"background is {background}", "rows of the background in every step of the dynamics"),
        ("background made once", _is_asymmetric(spec, model), "in this model frozen particles see only each other",
         f"background is {background}" if model.dynamics.is_asymmetric else "in this model frozen particles see all",
         "features of the background at every stage, kept for a rollout"),
        ("sleep", dynamics.sleep is not None, "particles at rest are skipped", "dynamics.sleep is absent",
         "counters of rest, results of sleepers"),
        ("actions", False, "", _absent("dynamics.actions", dynamics.actions, "no names"), "embeddings of actions"),
        ("contact pairs", False, "", _absent("dynamics.contact", dynamics.contact, "no pairs"), "groups of bodies"),
        ("view-dependent colour", sh_degree > 0, f"harmonics of degree {sh_degree}",
         "degree 0 is asked for or all the model has",
         "rows of the head for harmonics, their rotation, view directions"),
        ("changing features", appearance.changing != "none", f"of {appearance.changing} particles",
         "appearance.changing is none", "columns of the dynamics' last layer, new latents"),
        ("held bodies", bool(appearance.held) and appearance.changing != "none",
         f"appearance.held names {len(appearance.held)}, whose features stay",
         "nobody's features change" if appearance.held else "appearance.held names none", "a mark for each particle"),
        ("changing opacities", predicts_opacity and appearance.opacity_changes is not False, "this model predicts them",
         "appearance.opacity_changes is off" if predicts_opacity else "this model holds opacities",
         "a column of the dynamics' last layer, new opacities"),
        ("insertion", structure.insert, "edits may add particles", "structure.insert is off", "copies of the history"),
        ("removal", structure.remove, "edits may remove particles", "structure.remove is off", "copies of the history"),
        ("colour images", outputs.rgb, "outputs.rgb", "outputs.rgb is off",
         "harmonics of the head, an image of 3 channels"),
        ("depth images", outputs.depth, "a channel of the same pass", "outputs.depth is off", BLENDED),
        ("alpha images", outputs.alpha, "a channel of the same pass", "outputs.alpha is off", BLENDED),
        ("feature images", outputs.features, "channels of the same pass", "outputs.features is off",
         "rows of latents, an image of their channels"),
    ]  # fmt: skip
    effects = tuple(PlannedEffect(name, on, why if on else why_not, takes) for name, on, why, why_not, takes in rows)
    return Plan(spec, history, sh_degree, effects)


def _is_asymmetric(spec: EffectsSpec, model: ModelConfig) -> bool:
    return model.dynamics.is_asymmetric and spec.dynamics.background in ("frozen", "asymmetric")


def _absent(name: str, value: object | None, empty: str) -> str:
    return f"{name} is absent" if value is None else f"{name} has {empty}"


def _check_supported(spec: EffectsSpec, model: ModelConfig) -> None:
    dynamics, outputs, published = spec.dynamics, spec.outputs, model.renderer.quirks != Quirks()
    refused = {
        "dynamics.actions": (dynamics.actions and dynamics.actions.names, "this model has no embeddings of actions"),
        "dynamics.contact": (dynamics.contact and dynamics.contact.pairs, "particles do not know their body"),
        "dynamics.background asymmetric": (
            dynamics.background == "asymmetric" and not model.dynamics.is_asymmetric,
            "in this model frozen particles see all others",
        ),
        "dynamics.sleep.policy approx": (
            dynamics.sleep and dynamics.sleep.policy == "approx" and not model.dynamics.is_asymmetric,
            "this model cannot tell sleepers from others (dynamics.background is symmetric); the policy exact it can",
        ),
        "appearance.opacity_changes": (
            spec.appearance.opacity_changes and not model.dynamics.explicit, "this model holds opacities"
        ),
        "outputs": (
            not (outputs.rgb or outputs.depth or outputs.alpha or outputs.features), "there is no image to make"
        ),
        "outputs.features": (
            outputs.features and model.renderer.latents == 0, "this model's particles have no latents"
        ),
        "outputs without colour": (not outputs.rgb and published, "the published renderer draws colour"),
        "outputs.features with quirks": (outputs.features and published, "the published renderer draws none"),
    }  # fmt: skip
    for name, (asked, why) in refused.items():
        if asked:
            raise UnsupportedEffect(f"unsupported effect {name}: {why}; leave it out")


def _up_to(name: str, asked: int | None, largest: int) -> int:
    if asked is not None and asked > largest:
        raise UnsupportedEffect(f"unsupported effect {name}: this model goes up to {largest}; got {asked}")
    return largest if asked is None else asked


def unused_parameters(plan: Plan, model: ModelConfig, names: Iterable[str]) -> tuple[str, ...]:
    """Of the parameters ``names``, those that ``plan`` does not read."""
    config = model.dynamics
    merged = _merged_bits(config, plan.history)
    tables = {f"dynamics.net.encoder.{s}.merge.time_embedding" for s, bits in enumerate(merged) if bits == 0}
    return tuple(name for name in names if name in tables)


def _merged_bits(config: DynamicsConfig, history: int) -> tuple[int, ...]:
    """Of each stage; steps are counted back from the newest: it has its place in every table that the model has."""
    bits = config.history_bits if config.slots_from_newest else (history - 1).bit_length()
    return config.pyramid_spec(bits).merged_bits()


def predicted_cost(plan: Plan, model: ModelConfig, work: Workload) -> dict[str, float]:
    """Multiply-adds of one simulated step and its images: of the dynamics, of the Gaussians' head, and of the images.

    Counted from the sizes of layers, for particles on surfaces whose spacing is that of the grid; what is not a matrix
    product, an attention or a splat is left out. A ratio of two plans of one model tells more than a number.
    """
    background = plan.spec.dynamics.background
    moving = work.moving + (work.frozen if background == "dynamic" else 0)
    frozen = work.frozen if background in ("frozen", "asymmetric") else 0
    beside = frozen if _is_asymmetric(plan.spec, model) else 0
    drawn = moving + frozen
    frozen_steps = 1 if model.dynamics.is_relightable else plan.history
    seen = moving * plan.history + (frozen - beside) * frozen_steps
    renderer, outputs = model.renderer, plan.spec.outputs
    harmonics = 3 * (plan.sh_degree + 1) ** 2 if outputs.rgb else 0
    hidden = 4 * renderer.latents
    channels = 3 * outputs.rgb + outputs.depth + renderer.latents * outputs.features
    splats = min(drawn, SPLATS_A_PIXEL) * work.pixels
    return {
        "dynamics": _network(model.dynamics, seen, plan.history, beside) if moving else 0.0,
        "gaussians": float(drawn * hidden * (renderer.latents + harmonics + 7)),
        "images": float(work.views * (drawn * (PROJECTION + harmonics) + splats * (BLENDING + channels))),
    }


def background_cost(plan: Plan, model: ModelConfig, work: Workload) -> float:
    """Multiply-adds, counted likewise, of a background that is made once a rollout; 0 where every step computes it."""
    return _network(model.dynamics, work.frozen, 1) if _is_asymmetric(plan.spec, model) and work.frozen else 0.0


def _network(config: DynamicsConfig, rows: float, history: int, beside: float = 0.0) -> float:
    """Multiply-adds of the dynamics network on ``rows`` rows of stage 0, which see ``beside`` others that rest."""
    from gsim3d.dynamics.state import StateLayout

    layout, channels = StateLayout.of(config), config.encoder_channels
    merged = config.pyramid_spec((history - 1).bit_length()).merged_bits()
    total = rows * STEM_KERNEL**SURFACE * layout.in_channels * channels[0]
    at_stage = []
    for s in range(config.n_stages):
        if s > 0:
            total += rows * channels[s - 1] * channels[s]
            fewer = config.strides[s - 1] ** SURFACE
            rows, beside = rows / fewer / 2 ** merged[s], beside / fewer
        at_stage.append((rows, beside))
        total += config.encoder_depths[s] * _block(config, rows, beside, channels[s], config.patch_sizes[s])
    below = channels[-1]
    for s in reversed(range(config.n_stages - 1)):
        width, (rows, beside) = config.decoder_channels[s], at_stage[s]
        total += at_stage[s + 1][0] * below * width + rows * channels[s] * width
        total += config.decoder_depths[s] * _block(config, rows, beside, width, config.patch_sizes[s])
        below = width
    return float(total + rows / history * below * (below + layout.out_channels))


def _block(config: DynamicsConfig, rows: float, beside: float, channels: int, patch: int) -> float:
    """A row attends to its own patch, and to one of those that rest."""
    dense = (BLOCK_KERNEL**SURFACE + 1 + 4 + 2 * config.mlp_ratio) * channels**2
    return rows * (dense + 2 * (min(rows, patch) + min(beside, patch)) * channels)


def in_columns(rows: list[tuple[str, ...]]) -> str:
    """A table whose columns are as wide as their longest entry; the last one as it is."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
    lines = ("  ".join(text.ljust(width) for text, width in zip(row, [*widths, 0], strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)
