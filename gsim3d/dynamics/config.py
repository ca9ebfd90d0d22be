"""Configuration of the dynamics."""

from dataclasses import dataclass
from typing import ClassVar

from gsim3d.errors import InputError, check_one_of, check_ranges
from gsim3d.nn.graph_network import MAX_HISTORY_BITS, GraphConfig, graph_spec
from gsim3d.nn.point_transformer import TransformerConfig
from gsim3d.ops.curve import PyramidSpec
from gsim3d.priors import Prior, PriorConfig, PriorList

PREDICTS = ("from_newest", "from_previous", "absolute")
BACKGROUNDS = ("symmetric", "asymmetric", "relightable")


@dataclass(frozen=True, kw_only=True)
class DynamicsConfig(TransformerConfig):
    """Configuration of the dynamics: its network, outputs, priors and background, on top of the transformer's."""

    #: the network is a graph network of this size, which reads no settings of levels, patches and blocks; None: the
    #: point transformer
    graph: GraphConfig | None = None
    dynamic_latents: int = 32  #: channels of ``Particles.dynamic_latents``
    static_latents: int = 32  #: channels of ``Particles.static_latents``
    explicit: bool = False  #: particles carry Gaussian parameters (quats, scales, sh), which the network changes
    sh_degree: int = 3  #: degree of the spherical harmonics of explicit particles
    scale_min: float = 0.0002  #: smallest scale of explicit particles in metres
    scale_max: float = 0.1  #: largest scale of explicit particles in metres
    #: "from_newest": the change from the newest state of the history to each later state; "from_previous": the change
    #: from the previous state; "absolute": the state itself
    predicts: str = "from_newest"
    steps_per_call: int = 1  #: steps that one call of the network predicts
    #: largest displacement in a step along each axis in metres; None: unlimited, as changes of scales
    max_step: float | None = 0.5
    max_latent_step: float | None = None  #: largest change of each dynamic latent in a step; None: unlimited
    #: adds positions relative to the scene's origin and inside the cell to the network's input. Without them the motion
    #: is translation-invariant, and learning the height of the ground takes more data.
    position_features: bool = False
    position_length: float = 1.0  #: unit of the relative positions in metres
    priors: tuple[PriorConfig, ...] = ()  #: hand-made physics in order of application (:mod:`gsim3d.priors`)
    #: "symmetric": the network treats frozen particles as all others, and changes their latents; "asymmetric": frozen
    #: particles attend only to each other, never change, and are computed once a rollout, and moving particles attend
    #: to both (:mod:`gsim3d.dynamics.frozen_context`); "relightable": the network reads frozen particles in the newest
    #: step only, with their initial latents, and predicts changes from these, so that errors of shadows do not
    #: accumulate; bodies with changing latents are treated the same way. The weights have the same shapes for all
    #: three; use the same value for training and simulation.
    background: str = "symmetric"
    shuffle_orders: bool = True  #: shuffles the four curves of each level in training
    #: types of points of actors, each with a learned embedding (:mod:`gsim3d.dynamics.actions`). Empty: the model has
    #: no action particles.
    actions: tuple[str, ...] = ()

    max_opacity: ClassVar[float] = 1.0  # largest opacity of a particle
    frozen_turn: ClassVar[bool] = False  # whether the orientation of frozen explicit particles changes

    def __post_init__(self):
        super().__post_init__()
        check_one_of("DynamicsConfig: predicts", self.predicts, PREDICTS)
        check_one_of("DynamicsConfig: background", self.background, BACKGROUNDS)
        if self.is_asymmetric and self.norm == "batch":
            raise ValueError('DynamicsConfig: background="asymmetric" needs norm="layer"')
        if self.is_relightable and self.explicit:
            raise ValueError('DynamicsConfig: background="relightable" does not support explicit models')
        if self.graph is not None and (self.norm == "batch" or self.is_asymmetric):
            raise InputError('DynamicsConfig: graph needs norm="layer", and background="symmetric" or "relightable"')
        if self.graph is not None and self.history_bits > MAX_HISTORY_BITS:
            most = f"history_bits of at most {MAX_HISTORY_BITS}"
            raise InputError(f"DynamicsConfig: graph needs {most}; got {self.history_bits}")
        if self.steps_per_call < 1:
            raise ValueError(f"DynamicsConfig: steps_per_call must be at least 1; got {self.steps_per_call}")
        check_ranges(self, position_length=(1e-6, 1e6), scale_max=(1e-6, 1e6), scale_min=(0, self.scale_max))
        check_ranges(self, max_step=(0, 1e6), max_latent_step=(0, 1e6), sh_degree=(0, 3), steps_per_call=(1, 10**5))
        check_ranges(self, dynamic_latents=(0, 10**4), static_latents=(0, 10**4))
        if self.actions and (self.explicit or self.steps_per_call > 1):
            raise InputError("DynamicsConfig: actions need a latent model (not explicit) of one step a call")
        if len(set(self.actions)) != len(self.actions) or "" in self.actions:
            raise InputError(f"DynamicsConfig: actions must be different names of types; got {list(self.actions)}")
        for prior in self.build_priors():
            self._check_prior(prior)

    def build_priors(self) -> PriorList:
        """Returns the modules of ``priors`` with initial weights."""
        return PriorList([config.build() for config in self.priors])

    def _check_prior(self, prior: Prior) -> None:
        needs = {
            "one step a call": prior.acts and self.steps_per_call > 1,
            'predicts "from_newest" or "from_previous"': prior.acts and self.predicts == "absolute",
            "a latent model (not explicit)": prior.latent_only and self.explicit,
            'background "symmetric" or "relightable"': prior.reads_background and self.is_asymmetric,
            "a model without actions": prior.acts and not prior.is_local and bool(self.actions),
            "the point transformer (no graph)": self.graph and (prior.n_conv_features or prior.n_features),
        }
        for needed, lacks in needs.items():
            if lacks:
                raise InputError(f"DynamicsConfig: prior {prior.name} needs {needed}")

    @property
    def network(self) -> str:
        """Name of the network, for reports."""
        return "point transformer" if self.graph is None else "graph network"

    @property
    def out_channels(self) -> int:
        """Channels of a particle behind the network."""
        return super().out_channels if self.graph is None else self.graph.channels

    def pyramid_spec(self, history_bits: int) -> PyramidSpec:
        """What the geometry op needs to know, for a history of up to 2^history_bits steps."""
        return super().pyramid_spec(history_bits) if self.graph is None else graph_spec(self.grid_size, history_bits)

    @property
    def is_asymmetric(self) -> bool:
        return self.background == "asymmetric"

    @property
    def is_relightable(self) -> bool:
        return self.background == "relightable"
