"""Base classes of priors: their configuration, the context that they share in a step, and their interface."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gsim3d.cameras import Frames
from gsim3d.errors import InputError, check_ranges
from gsim3d.nn.layers import RowLinear
from gsim3d.nn.point_transformer import STEM_KERNEL, SparseConv
from gsim3d.priors.movable import Movable, Windows
from gsim3d.state import ATTRIBUTES, Particles, cached_zero, newest_clouds, take_runs, with_attribute

MAX_GAIN = 2.0  # gains are bounded to [-MAX_GAIN, MAX_GAIN]


@dataclass(frozen=True)
class PriorConfig:
    """Base class of the configuration of a prior.

    A subclass defines ``type``, the name of the prior in YAML lists. ``class MyPrior(Prior, config=MyConfig)`` makes
    :meth:`build` return a ``MyPrior``.

    Attributes:
        type: type of the prior, also its name in a model.
        version: version of the settings; any other than the class's is refused.
    """

    type: str = ""
    version: int = 1

    VARIANTS: ClassVar[dict] = {}
    RANGES: ClassVar[dict] = {}  # setting -> (smallest, largest) allowed value
    PRIOR: ClassVar[Any] = None

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        known = PriorConfig.VARIANTS.get(cls.type, cls)
        if not cls.type or known.__qualname__ != cls.__qualname__:  # a notebook may define one again
            raise InputError(f"{cls.__name__}: needs a type that no other prior has; got {cls.type!r}")
        PriorConfig.VARIANTS[cls.type] = cls

    def __post_init__(self):
        known = type(self)
        if (self.type or known.type, self.version) != (known.type, known.version):
            raise InputError(
                f"prior {known.type}: this version of gsim3d has type {known.type!r}, version {known.version}; "
                f"got {self.type!r}, version {self.version}"
            )
        object.__setattr__(self, "type", known.type)
        check_ranges(self, **known.RANGES)

    def build(self) -> Prior:
        """Returns a prior with these settings and initial weights."""
        return self.PRIOR(self)


@dataclass(frozen=True)
class Motion:
    """Displacements [N, 3] of one step in metres, as four terms that the priors rewrite in order.

    Attributes:
        inertial: displacement without forces.
        gained: sum of known motions, weighted by the predicted gains.
        elastic: displacement towards the rest shape; moves no body as a whole.
        network: displacement that the network predicts directly.
    """

    inertial: Tensor
    gained: Tensor
    elastic: Tensor
    network: Tensor

    @classmethod
    def of_network(cls, network: Tensor) -> Motion:
        """A motion whose other terms are zero."""
        return cls(*[cached_zero(network.dtype, network.device).expand_as(network)] * 3, network)

    def total(self) -> Tensor:
        """The sum of the four terms."""
        return self.network + ((self.inertial + self.gained) + self.elastic)


class StepContext:
    """Quantities that the priors share in one step, each computed on first use.

    Attributes:
        history: input particles [M], clouds sorted by (scene, step).
        newest: index of the newest cloud of each scene.
        state: particles [N] of the newest clouds.
        grid_size: edge of a network cell in metres.
        max_steps: largest number of steps in a history.
        priors: priors of the model.
        changes: attribute -> particles that a step changes: "all", "dynamic", "frozen" or "none".
        n_views: images of each encoded cloud; None: not known to be equal for all clouds.
        awake: bool [N], particles that the network received; None: all. Set after the network has run.
    """

    def __init__(
        self,
        history: Particles,
        priors: PriorList,
        grid_size: float,
        max_steps: int,
        *,
        most_movable: int | None = None,
        changes: dict[str, str] | None = None,
        rows: Callable[..., Tensor] | None = None,
        state: Callable[[], Particles] | None = None,
    ):
        self.history, self.priors, self.grid_size, self.max_steps = history, priors, grid_size, max_steps
        self.newest = newest_clouds(history.clouds)
        self.runs = history.clouds.row_runs(self.newest)
        self.changes, self.awake, self.n_views = changes, None, None
        self._most_movable, self._rows, self._shared = most_movable, rows, {}
        # Without self in it: a cycle would keep the autograd graph until the next garbage collection.
        self._make_state = state if state is not None else lambda newest=self.newest: history.select_clouds(newest)

    @property
    def state(self) -> Particles:
        return self.cached("state", self._make_state)

    @property
    def movable(self) -> Movable:
        return self.cached("movable", lambda: Movable(self.history, self.grid_size, self._most_movable))

    @property
    def is_empty(self) -> bool:
        """Whether the newest clouds have no particles. ``movable`` is then undefined."""
        return all(begin == end for begin, end in self.runs)

    def windows(self, radius: float) -> Windows:
        """Gaussian windows of standard deviation ``radius`` metres around the movable particles.

        With segmentation, each window is one body, and samples are weighted by the inverse of their density.
        """
        segmented = self.history.body is not None
        make = lambda: Windows(self.movable, self.history, radius, evenly=segmented)  # noqa: E731
        return self.cached(("windows", radius), make)

    def cached(self, key: Any, make: Callable[[], Any]) -> Any:
        """Returns ``make()``, computed at most once a step for each ``key``."""
        if key not in self._shared:
            self._shared[key] = make()
        return self._shared[key]

    def with_particles(self, particles: Particles) -> StepContext:
        """A context of the same model for other particles."""
        most = self._most_movable
        return StepContext(particles, self.priors, self.grid_size, self.max_steps, most_movable=most)

    def select_newest(self, values: Tensor) -> Tensor:
        """Selects the values of the newest clouds: [M, ...] -> [N, ...]."""
        return take_runs(values, self.runs)

    def scatter_newest(self, values: Tensor, fill: float = 0.0) -> Tensor:
        """Scatters values of the newest clouds to all particles: [N, ...] -> [M, ...], ``fill`` elsewhere."""
        return put_runs(values, self.runs, self.history.n_rows, fill)

    def rows(self, attribute: str, changed: str | None = None) -> Tensor:
        """Mask bool [N, 1] of particles whose ``attribute`` this step changes; ``changed`` replaces its entry of
        ``changes``."""
        return self._rows(self.state, attribute, changed or self.changes[attribute], self.awake)


class Prior(nn.Module):
    """Base class of priors. The default methods do nothing.

    Projections start at zero: a prior added to a trained model has its effect without gains, and no other.

    Attributes:
        name: type of the prior, and name of its weights below ``dynamics.priors``.
        attributes: particle attributes that it uses; missing ones are created with their defaults.
        requires: types of priors that must precede it in the list.
        n_conv_features: channels of :meth:`conv_features`.
        n_features: channels of :meth:`features`.
        n_gains: channels of gains that the network predicts for it.
        gains_change: attribute that the gains change; they are not computed if a plan keeps it constant.
        replaces_displacement: whether the network predicts gains only, and no displacement.
        latent_only: whether it does not support explicit models.
        reads_background: whether it needs frozen particles in the history, which asymmetric models leave out.
        is_local: whether it moves a particle by its own attributes alone, so that action particles may be among them.
    """

    attributes: tuple[str, ...] = ()
    requires: tuple[str, ...] = ()
    n_conv_features = n_features = n_gains = 0
    gains_change = "means"
    replaces_displacement = latent_only = reads_background = is_local = False

    def __init_subclass__(cls, config: type[PriorConfig] | None = None, **kwargs):
        super().__init_subclass__(**kwargs)
        if unknown := [name for name in cls.attributes if name not in ATTRIBUTES]:
            raise InputError(f"{cls.__name__}: {unknown[0]!r} is no attribute of particles; add it in gsim3d/state.py")
        if config is not None:
            config.PRIOR = cls

    def __init__(self, config: PriorConfig):
        super().__init__()
        self.config, self.name = config, config.type
        self.conv_proj = self.in_proj = self.gain_head = None

    @property
    def acts(self) -> bool:
        """Whether it changes a step, and not only the input of the network."""
        return type(self).move is not Prior.move or type(self).finish is not Prior.finish

    def connect(self, stem_channels: int, head_channels: int) -> None:
        """Creates the zero-initialised projections of features into the stem and of the head into gains."""
        if self.n_conv_features:
            self.conv_proj = SparseConv(self.n_conv_features, stem_channels, STEM_KERNEL, bias=False)
        if self.n_features:
            self.in_proj = RowLinear(self.n_features, stem_channels, bias=False)
        if self.n_gains:
            self.gain_head = RowLinear(head_channels, self.n_gains)
        for linear in (self.conv_proj, self.in_proj, self.gain_head):
            for parameter in () if linear is None else linear.parameters():
                nn.init.zeros_(parameter)

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        """Initializes attributes of ``particles`` that were encoded from ``frames``, or edited (``frames`` None)."""
        return particles

    def begin(self, particles: Particles, ctx: StepContext) -> Particles:
        """Returns ``particles`` with the attributes of this prior. Called before each step."""
        for name in self.attributes:
            particles = with_attribute(particles, name)
        return particles

    def conv_features(self, ctx: StepContext) -> Tensor:
        """Features [M, n_conv_features] of the history, projected into the stem by a sparse convolution."""
        raise TypeError(f"{type(self).__name__} has n_conv_features and must define conv_features()")

    def features(self, ctx: StepContext) -> Tensor:
        """Features [M, n_features] of the history, projected into the stem by a linear layer."""
        raise TypeError(f"{type(self).__name__} has n_features and must define features()")

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        """Returns the updated motion. ``gains`` [N, n_gains] are the unbounded outputs of the network."""
        return motion

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        """Updates the attributes of this prior in ``step``, the state after the motion."""
        return step


class PriorList(nn.Module):
    """Priors of a model in order of application, each registered under its name."""

    def __init__(self, priors: Sequence[Prior] = ()):
        super().__init__()
        for prior in priors:
            missing = [name for name in prior.requires if name not in self._modules]
            if missing:
                raise InputError(f"priors: {prior.name} needs {missing[0]} before it in the list")
            if prior.name in self._modules:
                raise InputError(f"priors: {prior.name} is listed twice")
            self.add_module(prior.name, prior)

    def __iter__(self) -> Iterator[Prior]:
        return iter(self._modules.values())

    def __len__(self) -> int:
        return len(self._modules)

    def get(self, name: str) -> Prior | None:
        """The prior of that name, or None."""
        return self._modules.get(name)


def bounded(x: Tensor, limit: float | None) -> Tensor:
    """``limit * tanh(x)``; None: ``x``."""
    return x if limit is None else limit * torch.tanh(x)


def hold(rows: Tensor, newest: Tensor, later: Tensor) -> Tensor:
    """``later`` in ``rows``; elsewhere ``newest``, with the same bits and no gradient into ``later``."""
    return torch.where(rows, later, newest)


def bounded_gains(gains: Tensor) -> Tensor:
    """Network outputs [N, 3 n] as gains [N, n, 3] in [-MAX_GAIN, MAX_GAIN]."""
    return bounded(gains / MAX_GAIN, MAX_GAIN).unflatten(1, (-1, 3))


def put_runs(x: Tensor, runs: Sequence[tuple[int, int]], n_rows: int, fill: float = 0.0) -> Tensor:
    """Places the rows of ``x`` in the ranges ``runs`` of [n_rows, ...], with ``fill`` elsewhere."""
    pieces, end, blank = [], 0, x.new_full((), fill) if fill else cached_zero(x.dtype, x.device)
    for part, (begin, until) in zip(x.split([until - begin for begin, until in runs]), runs, strict=True):
        pieces += [blank.expand(begin - end, *x.shape[1:]), part]
        end = until
    return torch.cat([*pieces, blank.expand(n_rows - end, *x.shape[1:])])
