"""Plans: what a simulator computes for a spec, and the predicted cost."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.effects.spec import EffectsSpec, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.nn.graph_network import KERNEL
from gsim3d.nn.point_transformer import BLOCK_KERNEL, STEM_KERNEL
from gsim3d.presets import ModelConfig
from gsim3d.state import Particles

# Dimension of a surface in a grid: a kernel of K^3 taps has about K^2 neighbours; pooling keeps 1 / stride^2 particles.
SURFACE = 2
SPLATS_A_PIXEL = 30  # Gaussians blended in a pixel
BLENDING, PROJECTION = 12, 250  # multiply-adds of blending, and of projecting, a Gaussian


@dataclass(frozen=True)
class Plan:
    """What a simulator computes for a spec. Everything else launches no kernel and allocates no memory."""

    spec: EffectsSpec  #: effects of the scene
    history: int  #: steps in the model's input
    sh_degree: int  #: degree of the spherical harmonics of rendered colours
    priors: tuple[str, ...]  #: types of the model's priors in order of application
    switches: tuple[tuple[str, str], ...]  #: (name, setting) of every effect that is on
    outputs: tuple[str, ...]  #: names of the rendered images
    unused: tuple[str, ...] = ()  #: names of parameters that the plan does not read; checkpoints may lack them

    @property
    def on(self) -> tuple[str, ...]:
        """Names of all priors, switches and outputs that are on."""
        return (*self.priors, *(name for name, _ in self.switches), *self.outputs)


@dataclass(frozen=True)
class Workload:
    """Sizes of a scene, for cost predictions."""

    moving: int  #: movable particles of a step
    frozen: int  #: frozen particles of a step
    views: int = 1  #: images of a step
    pixels: int = 64 * 64  #: pixels of an image
    actions: int = 0  #: points of actors


def make_plan(spec: EffectsSpec, model: ModelConfig) -> Plan:
    """Returns the plan of a model for ``spec``.

    Raises:
        UnsupportedEffect: the model does not support an effect of ``spec``.
    """
    _check_supported(spec, model)
    dynamics, appearance, structure = spec.dynamics, spec.appearance, spec.structure
    history = _up_to("dynamics.history", dynamics.history, 2**model.dynamics.history_bits)
    sh_degree = _up_to("appearance.view_dependent", appearance.view_dependent, model.renderer.sh_degree)
    changing, n_frozen = appearance.changing != "none", len(appearance.frozen_appearance)
    has_background, once = dynamics.background in ("frozen", "asymmetric"), _is_asymmetric(spec, model)
    switches = [
        ("history", history > 1, f"{history} steps"),
        ("background", has_background, "computed once a rollout" if once else "computed in every step"),
        ("sleep", dynamics.sleep is not None, dynamics.sleep and dynamics.sleep.policy),
        ("actions", bool(dynamics.actions), f"types: {len(dynamics.actions)}"),
        ("view_dependent", sh_degree > 0, f"degree {sh_degree}"),
        ("changing", changing, appearance.changing),
        ("frozen_appearance", n_frozen > 0 and changing, f"selections: {n_frozen}"),
        ("opacity_changes", model.dynamics.explicit and appearance.opacity_changes is not False, "predicted"),
        ("insert", structure.insert, "by edits"),
        ("remove", structure.remove, "by edits"),
    ]
    outputs = tuple(field.name for field in dataclasses.fields(spec.outputs) if getattr(spec.outputs, field.name))
    priors = tuple(prior.type for prior in model.dynamics.priors)
    on = tuple((name, str(what)) for name, is_on, what in switches if is_on)
    return Plan(spec, history, sh_degree, priors, on, outputs)


def _is_asymmetric(spec: EffectsSpec, model: ModelConfig) -> bool:
    return model.dynamics.is_asymmetric and spec.dynamics.background in ("frozen", "asymmetric")


def _check_supported(spec: EffectsSpec, model: ModelConfig) -> None:
    dynamics, outputs = spec.dynamics, spec.outputs
    known = model.dynamics.actions
    unknown = [name for name in dynamics.actions if name not in known]
    refused = {
        "dynamics.actions": (
            bool(unknown), f"this model does not know the type {unknown[:1]}; it has {', '.join(known) or 'none'}"
        ),
        "dynamics.actions and dynamics.sleep": (
            bool(dynamics.actions and dynamics.sleep), "what actors touch must not sleep; leave sleep out"
        ),
        "dynamics.background asymmetric": (
            dynamics.background == "asymmetric" and not model.dynamics.is_asymmetric,
            "in this model frozen particles attend to all others",
        ),
        "dynamics.sleep.policy approx": (
            dynamics.sleep and dynamics.sleep.policy == "approx" and not model.dynamics.is_asymmetric,
            "it needs a model with an asymmetric background; use the policy exact",
        ),
        "appearance.opacity_changes": (
            spec.appearance.opacity_changes and not model.dynamics.explicit, "this model does not predict opacities"
        ),
        "outputs": (
            not (outputs.rgb or outputs.depth or outputs.alpha or outputs.features), "no output is on"
        ),
        "outputs.features": (
            outputs.features and model.renderer.latents == 0, "this model's particles have no latents"
        ),
    }  # fmt: skip
    for name, (asked, why) in refused.items():
        if asked:
            raise UnsupportedEffect(f"unsupported effect {name}: {why}; leave it out")


def _up_to(name: str, asked: int | None, largest: int) -> int:
    if asked is not None and asked > largest:
        raise UnsupportedEffect(f"unsupported effect {name}: this model supports at most {largest}; got {asked}")
    return largest if asked is None else asked


def unused_parameters(plan: Plan, model: ModelConfig, names: Iterable[str]) -> tuple[str, ...]:
    """Returns those of the parameters ``names`` that ``plan`` does not read."""
    config = model.dynamics
    # With slots counted from the newest step, all tables of time embeddings are used.
    bits = config.history_bits if config.slots_from_newest else (plan.history - 1).bit_length()
    merged = config.pyramid_spec(bits).merged_bits()
    tables = {f"dynamics.net.encoder.{s}.merge.time_embedding" for s, n in enumerate(merged) if n == 0}
    without_actions = not plan.spec.dynamics.actions
    return tuple(n for n in names if n in tables or without_actions and n.startswith("dynamics.actions."))


def predicted_cost(plan: Plan, model: ModelConfig, work: Workload) -> dict[str, float]:
    """Multiply-adds of one simulated step and its images: "dynamics", "gaussians" (the head) and "images".

    Counts matrix products, attention and splats, for particles on surfaces with the spacing of the grid. Ratios between
    two plans of a model are meaningful; absolute numbers are not.
    """
    background = plan.spec.dynamics.background
    moving = work.moving + (work.frozen if background == "dynamic" else 0)
    frozen = work.frozen if background in ("frozen", "asymmetric") else 0
    context = frozen if _is_asymmetric(plan.spec, model) else 0
    drawn = moving + frozen
    frozen_steps = 1 if model.dynamics.is_relightable else plan.history
    acting = work.actions if plan.spec.dynamics.actions else 0
    seen = (moving + acting) * plan.history + (frozen - context) * frozen_steps
    renderer, outputs = model.renderer, plan.spec.outputs
    harmonics = 3 * (plan.sh_degree + 1) ** 2 if outputs.rgb else 0
    hidden = 4 * renderer.latents
    channels = 3 * outputs.rgb + outputs.depth + renderer.latents * outputs.features
    splats = min(drawn, SPLATS_A_PIXEL) * work.pixels
    return {
        "dynamics": _network(model.dynamics, seen, plan.history, context) if moving else 0.0,
        "gaussians": float(drawn * hidden * (renderer.latents + harmonics + 7)),
        "images": float(work.views * (drawn * (PROJECTION + harmonics) + splats * (BLENDING + channels))),
    }


def background_cost(plan: Plan, model: ModelConfig, work: Workload) -> float:
    """Multiply-adds of a background that is computed once a rollout; 0 if each step computes it."""
    return _network(model.dynamics, work.frozen, 1) if _is_asymmetric(plan.spec, model) and work.frozen else 0.0


def _network(config: DynamicsConfig, particles: float, history: int, context: float = 0.0) -> float:
    """Multiply-adds of the dynamics network on ``particles`` with a context of ``context`` frozen particles."""
    from gsim3d.dynamics.step import StateLayout

    layout, channels = StateLayout.of(config), config.encoder_channels
    if config.graph is not None:
        return _graph(config, layout.in_channels, layout.out_channels, particles, particles / history)
    merged = config.pyramid_spec((history - 1).bit_length()).merged_bits()
    total = particles * STEM_KERNEL**SURFACE * layout.in_channels * channels[0]
    levels = []
    for s in range(config.n_stages):
        if s > 0:
            total += particles * channels[s - 1] * channels[s]
            fewer = config.strides[s - 1] ** SURFACE
            particles, context = particles / fewer / 2 ** merged[s], context / fewer
        levels.append((particles, context))
        total += config.encoder_depths[s] * _block(config, particles, context, channels[s], config.patch_sizes[s])
    below = channels[-1]
    for s in reversed(range(config.n_stages - 1)):
        width, (particles, context) = config.decoder_channels[s], levels[s]
        total += levels[s + 1][0] * below * width + particles * channels[s] * width
        total += config.decoder_depths[s] * _block(config, particles, context, width, config.patch_sizes[s])
        below = width
    return float(total + particles / history * below * (below + layout.out_channels))


def _graph(config: DynamicsConfig, inputs: int, outputs: int, particles: float, newest: float) -> float:
    """Multiply-adds of a graph network on ``particles``, each a node, of which ``newest`` receive edges."""
    width, layers, neighbours = config.graph.channels, config.graph.layers, KERNEL**SURFACE
    dense = particles * (inputs + (4 + 5 * (1 + layers)) * width) + newest * (width + outputs)
    return float((dense + neighbours * (3 * (particles - newest) + (1 + 2 * layers) * newest) * width) * width)


def _block(config: DynamicsConfig, particles: float, context: float, channels: int, patch: int) -> float:
    """Multiply-adds of a block. A particle attends to its own patch and to one patch of the context."""
    dense = (BLOCK_KERNEL**SURFACE + 1 + 4 + 2 * config.mlp_ratio) * channels**2
    return particles * (dense + 2 * (min(particles, patch) + min(context, patch)) * channels)


def by_plan(particles: Particles, plans: Sequence[Plan]) -> Iterator[tuple[Plan, list[int]]]:
    """Groups scenes by plan: yields each different plan with the clouds of its scenes. Raises InputError if the number
    of ``plans`` differs from that of scenes."""
    n_scenes = particles.origin.shape[0]
    if len(plans) != n_scenes:
        raise InputError(f"plans: there must be one for each of {n_scenes} scenes; got {len(plans)}")
    kinds: dict[str, tuple[Plan, list[int]]] = {}
    for cloud, scene in enumerate(particles.clouds.scenes):
        kinds.setdefault(plans[scene].spec.hash, (plans[scene], []))[1].append(cloud)
    yield from kinds.values()
