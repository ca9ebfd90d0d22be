"""What priors have in common: their settings, what a step shares among them, and what they may do to it."""

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
from gsim3d.state import Particles, newest_clouds, take_runs, with_attribute

MAX_GAIN = 2.0  # a gain is within plus and minus this


@dataclass(frozen=True)
class PriorConfig:
    """Settings of a prior. A subclass defines its ``type``, by which lists in YAML name it; a subclass of
    :class:`Prior` that names it is what :meth:`build` makes.

    Attributes:
        type: of the prior, which is also its name in a model.
        version: of the meaning of the settings; another one than the class's is refused.
    """

    type: str = ""
    version: int = 1

    VARIANTS: ClassVar[dict] = {}
    RANGES: ClassVar[dict] = {}  # of settings, both ends included
    PRIOR: ClassVar[Any] = None

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
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
        """The module with these settings and its first weights."""
        return self.PRIOR(self)


@dataclass(frozen=True)
class Motion:
    """Displacements [N, 3] of one step in metres, in the parts that priors rewrite in order.

    Attributes:
        inertial: what goes on by itself.
        gained: what predicted gains make of known motions.
        elastic: towards the rest shape; moves no body as a whole.
        network: what the network predicts freely.
    """

    inertial: Tensor
    gained: Tensor
    elastic: Tensor
    network: Tensor

    @classmethod
    def of_network(cls, network: Tensor) -> Motion:
        zero = torch.zeros_like(network)
        return cls(zero, zero, zero, network)

    def total(self) -> Tensor:
        return self.network + ((self.inertial + self.gained) + self.elastic)


class StepContext:
    """What priors share in one step, each part computed on first use.

    Attributes:
        history: clouds sorted by (scene, step).
        newest: indices of the newest cloud of each scene.
        state: their particles, N.
        grid_size: metres, edge of a cell of the network.
        max_steps: of a history.
        priors: of the model.
        changes: which particles a step changes, by attribute: "all", "dynamic", "frozen" or "none".
        n_views: images of each encoded cloud; None: not known to be as many for all.
        awake: bool [N], particles that the network saw; None: all. Known after the network has run.
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
        share: Callable[..., Tensor] | None = None,
    ):
        self.history, self.priors, self.grid_size, self.max_steps = history, priors, grid_size, max_steps
        self.newest = newest_clouds(history.clouds)
        self.runs = history.clouds.row_runs(self.newest)
        self.changes, self.awake, self.n_views = changes, None, None
        self._most_movable, self._share, self._shared = most_movable, share, {}

    @property
    def state(self) -> Particles:
        return self.once("state", lambda: self.history.select_clouds(self.newest))

    @property
    def movable(self) -> Movable:
        return self.once("movable", lambda: Movable(self.history, self.grid_size, self._most_movable))

    @property
    def is_empty(self) -> bool:
        """Whether the newest clouds have no particles; then there is nothing movable to ask for."""
        return all(begin == end for begin, end in self.runs)

    def windows(self, radius: float) -> Windows:
        """Windows of standard deviation ``radius`` metres around the movable particles; of segmented particles each is
        a body, whose particles count as much as the surface that they stand for."""
        segmented = self.history.body is not None
        make = lambda: Windows(self.movable, self.history, radius, evenly=segmented)  # noqa: E731
        return self.once(("windows", radius), make)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """What ``make`` returns, made at most once a step for each ``key``."""
        if key not in self._shared:
            self._shared[key] = make()
        return self._shared[key]

    def later(self, particles: Particles) -> StepContext:
        """The context of other particles of the same model."""
        most = self._most_movable
        return StepContext(particles, self.priors, self.grid_size, self.max_steps, most_movable=most)

    def of_newest(self, values: Tensor) -> Tensor:
        """[N, ...], of ``values`` of all particles of the history those of ``state``."""
        return take_runs(values, self.runs)

    def of_all(self, values: Tensor, other: float = 0.0) -> Tensor:
        """``values`` [N, ...] of ``state`` at their places among all particles of the history, ``other`` elsewhere."""
        return put_runs(values, self.runs, self.history.n_rows, other)

    def share(self, attribute: str, changed: str | None = None) -> Tensor:
        """[N, 1], 1 for particles whose ``attribute`` this step changes, 0 for others.

        changed: as an entry of ``changes``; None: that of the attribute.
        """
        return self._share(self.state, attribute, changed or self.changes[attribute], self.awake)


class Prior(nn.Module):
    """A hand-made part of a step. All methods have defaults that do nothing.

    Weights are zero at first: a prior that is added to a trained model changes nothing but what it does without gains.

    Attributes:
        name: its type, and the name of its weights below ``dynamics.priors``.
        attributes: of particles, which it needs; absent ones begin at their defaults.
        requires: types of priors that must come before it.
        n_conv_features, n_features: channels of what it gives the network.
        n_gains: channels that the network predicts for it.
        gains_change: the attribute that they change; where a plan keeps that, they are not computed.
        replaces_displacement: whether the network predicts no displacement besides gains.
        latent_only: whether it needs a model that is not explicit.
        reads_background: whether it needs a model whose steps see frozen particles, as asymmetric ones do not.
    """

    attributes: tuple[str, ...] = ()
    requires: tuple[str, ...] = ()
    n_conv_features = n_features = n_gains = 0
    gains_change = "means"
    replaces_displacement = latent_only = reads_background = False

    def __init_subclass__(cls, config: type[PriorConfig] | None = None, **kwargs):
        super().__init_subclass__(**kwargs)
        if config is not None:
            config.PRIOR = cls

    def __init__(self, config: PriorConfig):
        super().__init__()
        self.config, self.name = config, config.type
        self.conv_proj = self.in_proj = self.gain_head = None

    @property
    def acts(self) -> bool:
        """Whether it takes part in a step, beside what it gives the network."""
        return type(self).move is not Prior.move or type(self).finish is not Prior.finish

    def connect(self, stem_channels: int, head_channels: int) -> None:
        """Makes the projections between the network and what this prior gives and takes, all zero."""
        if self.n_conv_features:
            self.conv_proj = SparseConv(self.n_conv_features, stem_channels, STEM_KERNEL, bias=False)
        if self.n_features:
            self.in_proj = RowLinear(self.n_features, stem_channels, bias=False)
        if self.n_gains:
            self.gain_head = RowLinear(head_channels, self.n_gains)
        for parameter in (p for m in (self.conv_proj, self.in_proj, self.gain_head) if m for p in m.parameters()):
            nn.init.zeros_(parameter)

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        """``particles`` after they were encoded from ``frames`` or, without ``frames``, after an edit."""
        return particles

    def begin(self, particles: Particles, ctx: StepContext) -> Particles:
        """``particles`` with the attributes of this prior, before a step."""
        for name in self.attributes:
            particles = with_attribute(particles, name)
        return particles

    def conv_features(self, ctx: StepContext) -> Tensor:
        """[M, n_conv_features] of all M particles of the history, convolved with their neighbours'."""
        raise TypeError(f"{type(self).__name__} has n_conv_features and must define conv_features()")

    def features(self, ctx: StepContext) -> Tensor:
        """[M, n_features] of all M particles of the history, read particle by particle."""
        raise TypeError(f"{type(self).__name__} has n_features and must define features()")

    def move(self, motion: Motion, gains: Tensor, ctx: StepContext) -> Motion:
        """``motion`` as this prior leaves it; gains [N, n_gains] as predicted, without bounds."""
        return motion

    def finish(self, step: Particles, gains: Tensor, ctx: StepContext) -> Particles:
        """``step``, the state after the motion, with the attributes that this prior predicts."""
        return step


class PriorList(nn.Module):
    """The priors of a model in order, each registered under its name."""

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
        """The prior of that name; None where the model has none."""
        return self._modules.get(name)


def bounded(x: Tensor, limit: float | None) -> Tensor:
    """``x`` pressed into plus and minus ``limit``; None: as it is."""
    return x if limit is None else limit * torch.tanh(x)


def bounded_gains(gains: Tensor) -> Tensor:
    """Gains [N, 3 n] as factors [N, n, 3] within plus and minus ``MAX_GAIN``."""
    return bounded(gains / MAX_GAIN, MAX_GAIN).unflatten(1, (-1, 3))


def put_runs(x: Tensor, runs: Sequence[tuple[int, int]], n_rows: int, other: float = 0.0) -> Tensor:
    """[n_rows, ...], the rows of ``x`` one run after another; ``other`` elsewhere."""
    pieces, end = [], 0
    for part, (begin, until) in zip(x.split([until - begin for begin, until in runs]), runs, strict=True):
        pieces += [x.new_full((begin - end, *x.shape[1:]), other), part]
        end = until
    return torch.cat([*pieces, x.new_full((n_rows - end, *x.shape[1:]), other)])
