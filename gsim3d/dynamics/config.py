"""The shape of the dynamics model."""

from __future__ import annotations

from dataclasses import dataclass

from gsim3d.errors import InputError, check_ranges
from gsim3d.nn.point_transformer import TransformerConfig
from gsim3d.priors import Prior, PriorConfig, PriorList

PREDICTS = ("from_newest", "from_previous", "absolute")
BACKGROUNDS = ("symmetric", "asymmetric", "relightable")


@dataclass(frozen=True, kw_only=True)
class DynamicsConfig(TransformerConfig):
    """What the dynamics predicts, from what, and with which priors; beside the settings of its network.

    Attributes:
        dynamic_latents, static_latents: channels of Particles.dynamic_latents and .static_latents.
        explicit: particles carry their own Gaussian parameters (quats, scales, sh), and all of them change with time.
        sh_degree: of explicit particles.
        scale_min, scale_max: metres, limits of explicit scales.
        predicts: "from_newest": the network predicts how much each later state differs from the newest one of the
            history; "from_previous": from the state one step before it; "absolute": the state itself.
        steps_per_call: steps that one call of the network predicts.
        max_step: metres; one step moves a particle by this at most along each axis. None: no limit, and none to how
            much a scale changes.
        max_latent_step: the same for each dynamic latent. None: no limit.
        position_features: the network also sees positions relative to the scene's origin (in units of
            ``position_length`` metres) and inside the cell. Learning where the ground is takes far less data so;
            without it the network knows particles by their neighbours only, and motion does not depend on positions.
        position_length: metres, unit of these positions.
        priors: hand-made physics, in the order in which it applies (:mod:`gsim3d.priors`); none: all is learned.
        background: "symmetric": frozen particles are like others to the network, and their latents change;
            "asymmetric": frozen particles of the newest step read each other only, never change, and are computed once
            a rollout; the others read both (:mod:`gsim3d.dynamics.frozen_context`); "relightable": the network sees
            frozen particles in the newest step only and as they were when the simulation began; it predicts by how much
            their latents differ from that now, so that the errors of shadows do not add up, and in the same way those
            of bodies where a plan lets them change. Weights fit all; train as you simulate.
        shuffle_orders: in training the four curves of a stage change places at random.
    """

    dynamic_latents: int = 32
    static_latents: int = 32
    explicit: bool = False
    sh_degree: int = 3
    scale_min: float = 0.0002
    scale_max: float = 0.1
    predicts: str = "from_newest"
    steps_per_call: int = 1
    max_step: float | None = 0.5
    max_latent_step: float | None = None
    position_features: bool = False
    position_length: float = 1.0
    priors: tuple[PriorConfig, ...] = ()
    background: str = "symmetric"
    shuffle_orders: bool = True

    def __post_init__(self):
        super().__post_init__()
        if self.predicts not in PREDICTS:
            raise ValueError(f"DynamicsConfig: predicts must be one of {', '.join(PREDICTS)}; got {self.predicts!r}")
        if self.background not in BACKGROUNDS:
            raise ValueError(
                f"DynamicsConfig: background must be one of {', '.join(BACKGROUNDS)}; got {self.background!r}"
            )
        if self.is_asymmetric and self.norm == "batch":
            raise ValueError('DynamicsConfig: background="asymmetric" needs norm="layer"')
        if self.is_relightable and self.explicit:
            raise ValueError('DynamicsConfig: background="relightable" needs a model that is not explicit')
        if self.steps_per_call < 1:
            raise ValueError(f"DynamicsConfig: steps_per_call must be at least 1; got {self.steps_per_call}")
        check_ranges(self, position_length=(1e-6, 1e6), scale_max=(1e-6, 1e6), scale_min=(0, self.scale_max))
        check_ranges(self, max_step=(0, 1e6), max_latent_step=(0, 1e6), sh_degree=(0, 3), steps_per_call=(1, 10**5))
        check_ranges(self, dynamic_latents=(0, 10**4), static_latents=(0, 10**4))
        for prior in self.build_priors():
            self._check_prior(prior)

    def build_priors(self) -> PriorList:
        """The modules of ``priors``, with their first weights."""
        return PriorList([config.build() for config in self.priors])

    def _check_prior(self, prior: Prior) -> None:
        needs = {
            "one step a call": prior.acts and self.steps_per_call > 1,
            'predicts "from_newest" or "from_previous"': prior.acts and self.predicts == "absolute",
            "a latent model (not explicit)": prior.latent_only and self.explicit,
            'background "symmetric" or "relightable"': prior.reads_background and self.is_asymmetric,
        }
        for needed, lacks in needs.items():
            if lacks:
                raise InputError(f"DynamicsConfig: prior {prior.name} needs {needed}")

    @property
    def is_asymmetric(self) -> bool:
        return self.background == "asymmetric"

    @property
    def is_relightable(self) -> bool:
        return self.background == "relightable"

    @property
    def max_opacity(self) -> float:
        """The largest opacity of a particle."""
        return 1.0

    @property
    def frozen_turn(self) -> bool:
        """Whether frozen explicit particles change their orientation."""
        return False
