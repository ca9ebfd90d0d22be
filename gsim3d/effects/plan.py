"""Plans: what a simulator computes for a spec."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from gsim3d.effects.spec import EffectsSpec, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.presets import ModelConfig
from gsim3d.state import Particles


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
    has_background, once = dynamics.background in ("frozen", "asymmetric"), is_asymmetric(spec, model)
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


def is_asymmetric(spec: EffectsSpec, model: ModelConfig) -> bool:
    return model.dynamics.is_asymmetric and spec.dynamics.background in ("frozen", "asymmetric")


def _check_supported(spec: EffectsSpec, model: ModelConfig) -> None:
    dynamics, outputs = spec.dynamics, spec.outputs
    known, is_symmetric = model.dynamics.actions, not model.dynamics.is_asymmetric
    unknown = [name for name in dynamics.actions if name not in known]
    refused = {
        "dynamics.actions": (
            bool(unknown), f"this model does not know the type {unknown[:1]}; it has {', '.join(known) or 'none'}"
        ),
        "dynamics.actions and dynamics.sleep": (
            bool(dynamics.actions and dynamics.sleep), "what actors touch must not sleep; leave sleep out"
        ),
        "dynamics.background asymmetric": (
            dynamics.background == "asymmetric" and is_symmetric, "in this model frozen particles attend to all others"
        ),
        "dynamics.sleep.policy approx": (
            dynamics.sleep and dynamics.sleep.policy == "approx" and is_symmetric,
            "it needs a model with an asymmetric background; use the policy exact",
        ),
        "appearance.opacity_changes": (
            spec.appearance.opacity_changes and not model.dynamics.explicit, "this model does not predict opacities"
        ),
        "outputs": (not (outputs.rgb or outputs.depth or outputs.alpha or outputs.features), "no output is on"),
        "outputs.features": (outputs.features and not model.renderer.latents, "this model's particles have no latents"),
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
    merged = zip(config.pyramid_spec(bits).merged_bits()[1:], config.merge_windows)
    unread = [f"dynamics.net.encoder.{s}.merge" for s, (n, window) in enumerate(merged, 1) if n == 0 and window > 1]
    unread += ["dynamics.actions."] * bool(config.actions and not plan.spec.dynamics.actions)
    return tuple(n for n in names if n.startswith(tuple(unread))) if unread else ()


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
