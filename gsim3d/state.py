"""Particles and Gaussians: the state of a simulation.

Both are packed: particles of many clouds (a cloud is a scene at a time step) are concatenated, and ``cu_rows`` contains
the offset of each cloud. Sizes: B scenes, Q clouds, I images, N particles, C channels, H x W pixels. Units are metres
and pixels; axes are OpenCV's (x right, y down, z forward); quaternions are (w, x, y, z).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.cameras import TensorRecord
from gsim3d.errors import InputError

DYNAMIC, FROZEN, ASLEEP = 0, 1, 2  # values of Particles.activity


@functools.lru_cache(maxsize=512)
def _recent_constant(values: tuple[int, ...], device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.int64, device=device)


_stores: list[dict[tuple, Tensor]] = []
_cached_zeros = functools.cache(torch.inference_mode(False)(torch.zeros))


def constant(values: tuple[int, ...], device: torch.device) -> Tensor:
    """Returns a cached int64 tensor of ``values``, which must not be modified.

    The cache avoids host-to-device copies in repeated steps, so that they can be captured in a CUDA graph.
    """
    if torch.compiler.is_compiling():
        return torch.tensor(values, dtype=torch.int64, device=device)
    if not _stores:
        return _recent_constant(values, device)
    key = values, torch.device(device)
    if key not in _stores[-1]:
        _stores[-1][key] = _recent_constant(values, device)
    return _stores[-1][key]


@contextlib.contextmanager
def keeping_constants(store: dict[tuple, Tensor]) -> Iterator[None]:
    """Context that stores every :func:`constant` in ``store``, which keeps them alive for a captured graph."""
    _stores.append(store)
    try:
        yield
    finally:
        _stores.pop()


@dataclass(frozen=True, eq=False)
class CloudTable:
    """Host copy of ``cu_rows``, ``cloud_scene`` and ``cloud_step`` of packed clouds.

    Attributes:
        starts: Q + 1 row offsets.
        scenes, steps: scene and step of each of Q clouds.
        tensors: the three tensors on the device of the particles.
    """

    starts: tuple[int, ...]
    scenes: tuple[int, ...]
    steps: tuple[int, ...]
    tensors: tuple[Tensor, Tensor, Tensor]

    @classmethod
    def read(cls, cu_rows: Tensor, cloud_scene: Tensor, cloud_step: Tensor) -> CloudTable:
        """Copies the tensors to the host, with one device synchronisation."""
        values = torch.cat([cu_rows, cloud_scene, cloud_step]).tolist()
        n, m = cu_rows.shape[0], cu_rows.shape[0] + cloud_scene.shape[0]
        tensors = (cu_rows, cloud_scene, cloud_step)
        return cls(tuple(values[:n]), tuple(values[n:m]), tuple(values[m:]), tensors)

    @classmethod
    def make(
        cls, counts: Iterable[int], scenes: Iterable[int], steps: Iterable[int], device: torch.device
    ) -> CloudTable:
        """Builds a table from the number of particles, scene and step of each cloud."""
        numbers = tuple(accumulate(counts, initial=0)), tuple(scenes), tuple(steps)
        return cls(*numbers, tuple(constant(values, device) for values in numbers))

    def __len__(self) -> int:
        return len(self.scenes)

    def count(self, cloud: int) -> int:
        """Returns the number of particles of a cloud."""
        return self.starts[cloud + 1] - self.starts[cloud]

    @property
    def counts(self) -> list[int]:
        """Number of particles of each cloud."""
        return [self.count(cloud) for cloud in range(len(self))]

    def with_counts(self, counts: Iterable[int]) -> CloudTable:
        """The same scenes and steps with other numbers of particles."""
        return self.make(counts, self.scenes, self.steps, self.tensors[0].device)

    def ahead(self, n_steps: int) -> CloudTable:
        """The same clouds ``n_steps`` later."""
        return self.make(self.counts, self.scenes, (step + n_steps for step in self.steps), self.tensors[0].device)

    def row_runs(self, clouds: Sequence[int]) -> list[tuple[int, int]]:
        """Returns the row ranges [begin, end) of ``clouds``; consecutive clouds are merged into one range."""
        runs, before = [], None
        for cloud in clouds:
            begin = runs.pop()[0] if before is not None and cloud == before + 1 else self.starts[cloud]
            runs.append((begin, self.starts[cloud + 1]))
            before = cloud
        return runs


def take_runs(x: Tensor, runs: Sequence[tuple[int, int]]) -> Tensor:
    """Concatenates the rows of ``runs``; returns a view if there is only one."""
    pieces = split_rows(x, runs)
    if len(pieces) == 1:
        return pieces[0]
    return torch.cat(pieces) if pieces else x[:0]


def split_rows(x: Tensor, runs: Sequence[tuple[int, int]]) -> list[Tensor]:
    """Returns views of the rows of each of ``runs``, which must not be modified."""
    ascends = all(a[1] <= b[0] for a, b in pairwise(runs))
    if ascends and x.requires_grad and torch.is_grad_enabled() and not torch.compiler.is_compiling():
        return list(_Pieces.apply(x, runs))
    return [x[begin:until] for begin, until in runs]


class _Pieces(torch.autograd.Function):
    """Rows of ascending ``runs``. The backward pass concatenates their gradients and zeros once; slices would add one
    zero-padded gradient of the size of ``x`` each, and ``split`` would store the zeros of each piece."""

    @staticmethod
    def forward(ctx, x: Tensor, runs: Sequence[tuple[int, int]]) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.shape, ctx.runs = x.shape, runs
        return tuple(x[begin:until] for begin, until in runs)

    @staticmethod
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, None]:
        known = [(run, grad) for run, grad in zip(ctx.runs, grads, strict=True) if grad is not None]
        if not known:
            return None, None
        pieces, end = [], 0
        for (begin, until), grad in known:
            zero = cached_zero(grad.dtype, grad.device)
            pieces += [zero.expand(begin - end, *ctx.shape[1:]), grad]
            end = until
        pieces.append(zero.expand(ctx.shape[0] - end, *ctx.shape[1:]))
        pieces = [piece for piece in pieces if len(piece)] or pieces[:1]
        return torch.cat(pieces) if len(pieces) > 1 else pieces[0], None


def cached_zero(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Returns a cached scalar 0, or a new one in compiled code."""
    return (torch.zeros if torch.compiler.is_compiling() else _cached_zeros)((), dtype=dtype, device=device)


@dataclass(frozen=True)
class Attribute:
    """Declaration of a per-particle tensor, used by concatenation, edits, validation and sleep.

    Attributes:
        name: field of :class:`Particles`.
        shape: shape after the particle dimension; None for sizes that depend on the model.
        kind: "scalar", "point" (translates and rotates with a body), "vector" or "quaternion" (rotate with it),
            "harmonics", "matrix", or "index" (discrete, without gradients).
        default: value for particles without the attribute: a number, "identity", or the name of the attribute to copy;
            None if it has no default.
        predicted: whether a step may change it.
        validated: whether every step validates it; others are validated once, at the start.
        dtype: dtype, if it is not that of the network.
    """

    name: str
    shape: tuple[int | None, ...] = (None,)
    kind: str = "scalar"
    default: float | str | None = None
    predicted: bool = True
    validated: bool = True
    dtype: torch.dtype | None = None

    @property
    def is_optional(self) -> bool:
        """Whether particles without the attribute can be concatenated with others that have it."""
        return self.default is not None


_kept = functools.partial(Attribute, predicted=False)
ATTRIBUTES = {
    attribute.name: attribute
    for attribute in (
        Attribute("means", (3,), "point"),
        Attribute("opacities", ()),
        Attribute("dynamic_latents"),
        _kept("static_latents"),
        _kept("activity", (), "index", validated=False, dtype=torch.uint8),
        Attribute("quats", (4,), "quaternion"),
        Attribute("scales", (3,)),
        Attribute("sh", (None, 3), "harmonics"),
        _kept("orientations", (4,), "quaternion", "identity"),
        _kept("color_transform", (3, 3), "matrix", "identity"),
        _kept("frozen_appearance", (), "index", 0.0, validated=False, dtype=torch.bool),
        _kept("actor", (), "index", -1, validated=False, dtype=torch.int64),
        _kept("initial_latents", default="dynamic_latents", validated=False),
        Attribute("velocity", (3,), "vector", 0.0),
        Attribute("mean_velocity", (3,), "vector", 0.0),
        Attribute("irradiance_gain", (3,), "scalar", 1.0),
        _kept("light_occlusion", default=-1.0, validated=False),
        _kept("rest_positions", (3,), "point", "means", validated=False),
        _kept("body", (3,), "point", "means", validated=False),
        _kept("label", (), "index", -1, validated=False, dtype=torch.int64),
    )
}

VELOCITIES = ("velocity", "mean_velocity")


def attributes_of(*kinds: str) -> tuple[str, ...]:
    """Returns the names of the attributes of these kinds."""
    return tuple(name for name, attribute in ATTRIBUTES.items() if attribute.kind in kinds)


@dataclass(frozen=True)
class Actions(TensorRecord):
    """Known motions of the points of actors, such as those on a pusher or the joints of a hand, in B scenes.

    A model with action particles (``model.dynamics.actions``) reads them if the plan has ``dynamics.actions`` on: to
    predict step t + 1, it receives the positions at t and the displacements to t + 1. A point rests before its first
    and after its last given step, and before it vanishes.

    Attributes:
        positions: float [B, T, A, 3] metres, world, finite; entry i of scene b is at step ``first[b] + i``. Gradients
            flow to it.
        types: int64 [B, T, A], index into ``names``; -1: the scene has no such point at that step.
        names: names of the types of points.
        first: step of the first position of each scene; empty: 0.
    """

    positions: Tensor
    types: Tensor
    names: tuple[str, ...]
    first: tuple[int, ...] = ()

    @classmethod
    def of(cls, positions: Tensor, types: Sequence[str]) -> Actions:
        """Returns the actions of scenes whose points have the same types.

        Args:
            positions: [B, T, A, 3] metres, from step 0 of each scene.
            types: type of each of the A points.

        Raises:
            InputError: shapes do not fit, or a position is not finite; names scene and step.
        """
        if isinstance(types, str):
            raise InputError(f"actions: types must be a list, one name for each point; got {types!r}")
        wanted = positions.dim() == 4 and 0 not in positions.shape[1:] and positions.shape[2:] == (len(types), 3)
        if not wanted or not positions.is_floating_point():
            got = f"{positions.dtype} {list(positions.shape)}"
            raise InputError(f"actions: positions must be float [B, T, {len(types) or 'A > 0'}, 3]; got {got}")
        finite = positions.detach().isfinite().flatten(2).all(2)
        if not bool(finite.all()):
            scene, step = (~finite).nonzero()[0].tolist()
            raise InputError(f"actions: positions of scene {scene}, step {step} must be finite")
        names = tuple(dict.fromkeys(types))
        index = torch.tensor([names.index(name) for name in types], device=positions.device)
        return cls(positions, index.expand(*positions.shape[:2], -1), names)

    @property
    def n_points(self) -> int:
        """Largest number of points of a scene, A."""
        return self.positions.shape[2]

    def at(self, clouds: CloudTable, later: int = 0) -> tuple[Tensor, Tensor]:
        """Returns positions [Q, A, 3] and types [Q, A], ``later`` steps after those of ``clouds``, without a sync."""
        first, n_steps, device = self.first or (0,) * len(self.types), self.positions.shape[1], self.positions.device
        given = zip(clouds.scenes, clouds.steps, strict=True)
        steps = tuple(min(max(step + later - first[scene], 0), n_steps - 1) for scene, step in given)
        entries = constant(clouds.scenes, device), constant(steps, device)
        return self.positions[entries], self.types[entries]

    def between(self, first: Sequence[int], n_steps: int) -> Actions:
        """Returns the ``n_steps`` steps of each scene from its step in ``first``."""
        scenes = [scene for scene in range(len(first)) for _ in range(n_steps)]
        steps = [begin + step for begin in first for step in range(n_steps)]
        table = CloudTable.make((0 for _ in scenes), scenes, steps, self.positions.device)
        positions, types = (value.unflatten(0, (len(first), n_steps)) for value in self.at(table))
        return dataclasses.replace(self, positions=positions, types=types, first=tuple(first))

    def select(self, scenes: Sequence[int]) -> Actions:
        """Returns the actions of ``scenes``, in their order."""
        chosen, first = list(scenes), tuple(self.first[scene] for scene in scenes) if self.first else ()
        return dataclasses.replace(self, positions=self.positions[chosen], types=self.types[chosen], first=first)


@dataclass(frozen=True)
class Particles(TensorRecord):
    """The state of the simulator: particles with view-independent latent features.

    Particles of different encoded steps do not correspond to each other; those of simulated steps do.

    Attributes:
        means: [N, 3] metres, world.
        opacities: [N] in (0, 1).
        dynamic_latents: [N, Fd], features that change with time.
        static_latents: [N, Fs], features that stay constant.
        cu_rows: int64 [Q + 1], offsets; the particles of cloud q are rows cu_rows[q] to cu_rows[q + 1].
        cloud_scene: int64 [Q], scene of each cloud; clouds are sorted by (scene, step).
        cloud_step: int64 [Q], step of each cloud.
        activity: uint8 [N]: 0 dynamic, 1 frozen (never moves), 2 asleep (never changes, and is hidden from the
            dynamics; see :mod:`gsim3d.numerics.policy`). Masked-out particles are absent.
        origin: float64 [B, 3] metres, lower corner of each scene's workspace.
        quats: [N, 4] (w, x, y, z); only in explicit models.
        scales: [N, 3] metres; only in explicit models.
        sh: [N, K, 3]; only in explicit models.
        orientations: [N, 4] (w, x, y, z), a rotation of the drawn appearance since encoding, from edits
            (:mod:`gsim3d.effects.edits`) and, in models that predict it, from the rotation of the particles around.
        color_transform: [N, 3, 3], a matrix that decoded colours of latent models are multiplied by; set by edits.
        frozen_appearance: bool [N], particles whose changing latents and colours stay constant; only where an effects
            spec selects them (``appearance.frozen_appearance``). Resolved once at the start of a rollout.
        actor: int64 [N], number of the actor (:mod:`gsim3d.effects.actors`) that moves a particle, -1: none.
        initial_latents: [N, Fd], the dynamic latents at the start, in models with ``background="relightable"``.
        velocity: [N, 3] metres per step: the last displacement of simulated particles, an estimate for encoded
            particles of the newest step, 0 otherwise; only in models with a prior that reads it.
        mean_velocity: as ``velocity``, over the last steps (:class:`gsim3d.priors.Velocity`).
        irradiance_gain: [N, 3], irradiance now over that at encoding, factors of colours in models with lights.
        light_occlusion: [N, 2 L], optical depth towards each light at encoding and now, or [N, 3 L]: irradiance at
            encoding, n.l, and irradiance now; negative where unknown.
        rest_positions: [N, 3] metres, positions at the start of the simulation, the rest shape of elastic bodies; only
            in models with shape matching.
        body: [N, 3] metres, centroid of the visible part of the particle's body at encoding, which identifies the body;
            only in models that segment bodies.
        label: int64 [N], a number that the caller gives, as of the view or body that it came from; not read by a step.
        world_offset: float64 [B, 3] metres, translation between the coordinates of each scene's files and those of
            cameras, origin and positions, which keeps the latter small enough for float32; None: 0. Edits and files use
            the coordinates of the scene's files.
        actions: motions of actors, which the dynamics receives as further particles; None: no actors.
        known: host copy of the cloud table; see :attr:`clouds`.
    """

    means: Tensor
    opacities: Tensor
    dynamic_latents: Tensor
    static_latents: Tensor
    cu_rows: Tensor
    cloud_scene: Tensor
    cloud_step: Tensor
    activity: Tensor
    origin: Tensor
    quats: Tensor | None = None
    scales: Tensor | None = None
    sh: Tensor | None = None
    orientations: Tensor | None = None
    color_transform: Tensor | None = None
    frozen_appearance: Tensor | None = None
    actor: Tensor | None = None
    initial_latents: Tensor | None = None
    velocity: Tensor | None = None
    mean_velocity: Tensor | None = None
    irradiance_gain: Tensor | None = None
    light_occlusion: Tensor | None = None
    rest_positions: Tensor | None = None
    body: Tensor | None = None
    label: Tensor | None = None
    world_offset: Tensor | None = None
    actions: Actions | None = None
    known: CloudTable | None = None

    ROW_FIELDS = tuple(ATTRIBUTES)

    @property
    def n_rows(self) -> int:
        """Number of particles, N."""
        return self.means.shape[0]

    @property
    def n_clouds(self) -> int:
        """Number of clouds, Q."""
        return self.cloud_scene.shape[0]

    @property
    def clouds(self) -> CloudTable:
        """Host copy of the cloud table; only its first use may synchronise the device."""
        tensors = (self.cu_rows, self.cloud_scene, self.cloud_step)
        if self.known is None or any(a is not b for a, b in zip(self.known.tensors, tensors)):
            table = CloudTable.read(*tensors)
            object.__setattr__(self, "known", table)
            return table
        return self.known

    def with_clouds(self, table: CloudTable, **fields: Tensor) -> Particles:
        """Returns particles with the cloud table ``table`` and other ``fields``."""
        cu_rows, scene, step = table.tensors
        return dataclasses.replace(self, **fields, cu_rows=cu_rows, cloud_scene=scene, cloud_step=step, known=table)

    @property
    def latents(self) -> Tensor:
        """All latents, [N, Fd + Fs], dynamic ones first."""
        return torch.cat([self.dynamic_latents, self.static_latents], 1)

    def row_fields(self) -> dict[str, Tensor]:
        """Returns the per-particle tensors by name."""
        return {name: value for name in self.ROW_FIELDS if (value := getattr(self, name)) is not None}

    def row_cloud(self) -> Tensor:
        """Returns the cloud of each particle, int64 [N]."""
        counts = self.cu_rows[1:] - self.cu_rows[:-1]
        return torch.repeat_interleave(
            torch.arange(self.n_clouds, device=counts.device), counts, output_size=self.n_rows
        )

    def row_scene(self) -> Tensor:
        """Returns the scene of each particle, int64 [N]."""
        return self.cloud_scene[self.row_cloud()]

    def row_origin(self) -> Tensor:
        """Returns the origin of each particle's scene, float64 [N, 3]."""
        return self.origin[self.row_scene()]

    def row_offset(self) -> Tensor | None:
        """Returns the ``world_offset`` of each particle's scene, float64 [N, 3]; None if there is none."""
        return None if self.world_offset is None else self.world_offset[self.row_scene()]

    def select_rows(self, rows: Tensor) -> Particles:
        """Keeps the particles selected by ``rows`` (bool [N]); clouds remain even if they become empty."""
        kept = torch.zeros(self.n_rows + 1, dtype=torch.int64, device=rows.device)
        kept[1:] = torch.cumsum(rows, 0)
        chosen = rows.nonzero()[:, 0]  # once for all fields, because it synchronises
        fields = {name: value[chosen] for name, value in self.row_fields().items()}
        return dataclasses.replace(self, **fields, cu_rows=kept[self.cu_rows])

    def select_clouds(self, clouds: Sequence[int] | Tensor) -> Particles:
        """Returns the particles of ``clouds``, which must ascend."""
        chosen = clouds.tolist() if isinstance(clouds, Tensor) else list(clouds)
        table, runs = self.clouds, self.clouds.row_runs(chosen)
        counts, scenes, steps = ([of[q] for q in chosen] for of in (table.counts, table.scenes, table.steps))
        table = CloudTable.make(counts, scenes, steps, self.cu_rows.device)
        return self.with_clouds(table, **{name: take_runs(x, runs) for name, x in self.row_fields().items()})


def newest_clouds(clouds: CloudTable) -> list[int]:
    """Returns the last cloud of each scene that has clouds."""
    return _last(clouds.scenes, clouds.steps, 1)


def _last(scenes: Sequence[int], steps: Sequence[int], n_steps: int) -> list[int]:
    """Returns the last ``n_steps`` clouds of each scene."""
    keys = list(zip(scenes, steps))
    if any(b <= a for a, b in zip(keys, keys[1:])):
        wanted, got = "sorted by (scene, step), without duplicates", f"scenes {list(scenes)}, steps {list(steps)}"
        raise ValueError(f"particles: clouds must be {wanted}; got {got}")
    return [q for q in range(len(scenes)) if scenes[q + n_steps : q + n_steps + 1] != scenes[q : q + 1]]


def append_step(history: Particles, step: Particles, max_steps: int) -> Particles:
    """Appends the clouds of ``step`` to ``history`` and keeps the last ``max_steps`` clouds of each scene."""
    return concatenate([history, step], max_steps)


def last_steps(particles: Particles, n_steps: int) -> Particles:
    """Returns the particles of the last ``n_steps`` clouds of each scene."""
    kept = _last(particles.clouds.scenes, particles.clouds.steps, n_steps)
    return particles if len(kept) == particles.n_clouds else particles.select_clouds(kept)


class Newest:
    """``last_steps(particles, 1)``, selected in the first call."""

    def __init__(self, particles: Particles):
        self._particles = particles
        self._newest: Particles | None = None

    def __call__(self) -> Particles:
        if self._newest is None:
            self._newest = last_steps(self._particles, 1)
        return self._newest


def with_velocity(particles: Particles, rows: Tensor, velocity: Tensor) -> Particles:
    """Returns ``particles`` with ``velocity`` [N, 3] where ``rows``, bool [N, 1], in those of VELOCITIES they have."""
    known = {name: value for name in VELOCITIES if (value := getattr(particles, name)) is not None}
    return dataclasses.replace(particles, **{name: torch.where(rows, velocity, known[name]) for name in known})


def with_attribute(particles: Particles, name: str, width: int = 3) -> Particles:
    """Returns ``particles`` with the attribute ``name``, set to its default if absent.

    Args:
        particles: the particles.
        name: name of the attribute.
        width: number of channels, if the attribute does not fix it.
    """
    if getattr(particles, name) is not None:
        return particles
    attribute, means = ATTRIBUTES[name], particles.means
    if attribute.default == "identity":
        one = means.new_ones(particles.n_rows, 1)
        value = F.pad(one, (0, 3)) if attribute.kind == "quaternion" else torch.diag_embed(one.expand(-1, 3))
    elif isinstance(attribute.default, str):  # copies are not validated, so invalid numbers are replaced here
        value = getattr(particles, attribute.default)
        value = (value.detach() if attribute.kind == "point" else value).nan_to_num(0, 0, 0)
    else:
        shape = (particles.n_rows, *(width if n is None else n for n in attribute.shape))
        value = means.new_full(shape, attribute.default, dtype=attribute.dtype or means.dtype)
    return dataclasses.replace(particles, **{name: value})


def with_same_attributes(parts: Sequence[Particles]) -> list[Particles]:
    """Adds to all ``parts`` the optional attributes that any of them has."""
    for name in (name for name, attribute in ATTRIBUTES.items() if attribute.is_optional):
        known = [getattr(part, name) for part in parts if getattr(part, name) is not None]
        if known:
            parts = [with_attribute(part, name, known[0].shape[-1]) for part in parts]
    return list(parts)


def concatenate(parts: Sequence[Particles], max_steps: int | None = None) -> Particles:
    """Concatenates particles of the same scenes, with clouds sorted by (scene, step).

    Args:
        parts: particles of the same scenes.
        max_steps: number of last clouds to keep of each scene; requires unique (scene, step). Default: keep all.
    """
    parts = with_same_attributes(parts)
    tables = [part.clouds for part in parts]
    clouds = [(table.scenes[q], table.steps[q], p, q) for p, table in enumerate(tables) for q in range(len(table))]
    clouds.sort(key=lambda cloud: cloud[:2])
    if max_steps is not None:
        scenes, steps = [cloud[0] for cloud in clouds], [cloud[1] for cloud in clouds]
        clouds = [clouds[i] for i in _last(scenes, steps, max_steps)]
    counts = [tables[p].count(q) for *_, p, q in clouds]
    scenes, steps = ([cloud[i] for cloud in clouds] for i in (0, 1))
    table = CloudTable.make(counts, scenes, steps, parts[0].cu_rows.device)
    taken = [sorted(q for *_, part, q in clouds if part == p) for p in range(len(parts))]
    runs = [[own.row_runs([q])[0] for q in chosen] for own, chosen in zip(tables, taken, strict=True)]
    order = {key: i for i, key in enumerate((p, q) for p, chosen in enumerate(taken) for q in chosen)}
    fields = {}
    for name, value in parts[0].row_fields().items():
        pieces = [rows for part, own in zip(parts, runs, strict=True) for rows in split_rows(getattr(part, name), own)]
        fields[name] = torch.cat([pieces[order[p, q]] for *_, p, q in clouds]) if clouds else value
    return parts[0].with_clouds(table, **fields)


def joined_clouds(particles: Particles, more: Particles) -> Particles:
    """Appends the particles of each cloud of ``more`` to the same cloud of ``particles``, without a device sync."""
    parts = with_same_attributes([particles, more])
    tables = [part.clouds for part in parts]
    runs = [[table.row_runs([q])[0] for q in range(len(table))] for table in tables]
    fields = {}
    for name in parts[0].row_fields():
        pieces = (split_rows(getattr(part, name), own) for part, own in zip(parts, runs, strict=True))
        fields[name] = torch.cat([piece for both in zip(*pieces, strict=True) for piece in both])
    return parts[0].with_clouds(tables[0].with_counts(map(sum, zip(*(table.counts for table in tables)))), **fields)


def single_steps(particles: Particles) -> list[Particles]:
    """Splits particles of scenes with equal numbers of steps into one Particles per step, with one cloud per scene."""
    n_scenes = len(newest_clouds(particles.clouds))
    n_steps = particles.n_clouds // n_scenes if n_scenes else 1
    if n_steps == 1:
        return [particles]
    return [particles.select_clouds(range(step, particles.n_clouds, n_steps)) for step in range(n_steps)]


@dataclass(frozen=True)
class Gaussians(TensorRecord):
    """3D Gaussians, packed like the particles they were decoded from.

    Attributes:
        means: [N, 3] metres.
        quats: [N, 4] (w, x, y, z).
        scales: [N, 3] metres.
        opacities: [N] in (0, 1).
        sh: [N, K, 3] coefficients of the standard 3DGS basis (K = (degree + 1)^2; colour = sum + 0.5, clamped at 0);
            None if colours are not needed.
        cu_rows: int64 [Q + 1], offsets of the clouds.
        world_offset: float64 [Q, 3] metres, ``world_offset`` of each cloud's scene; None: 0.
        antialiased: of a file that was trained with Mip-Splatting's compensation: pictures, videos and players multiply
            opacities by it.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor | None
    cu_rows: Tensor
    world_offset: Tensor | None = None
    antialiased: bool = False
