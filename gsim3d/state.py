"""Particles and Gaussians: the state of a simulation.

Both are ragged: rows of many clouds (a cloud is one scene at one time step) are packed one after another, and
``cu_rows`` says where each cloud starts. Sizes: B scenes, Q clouds, I images, N rows, C channels, H W pixels.
Units are metres and pixels; axes are OpenCV's (x right, y down, z forward); quaternions are (w, x, y, z).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from gsim3d.cameras import TensorRecord

DYNAMIC, FROZEN, ASLEEP = 0, 1, 2  # values of Particles.activity


@functools.lru_cache(maxsize=512)
def _recent_constant(values: tuple[int, ...], device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.int64, device=device)


_stores: list[dict[tuple, Tensor]] = []


def constant(values: tuple[int, ...], device: torch.device) -> Tensor:
    """int64 tensor of ``values``, the same object at every call: read it, never write to it.

    A step that repeats sends nothing to the device, and can be captured in a CUDA graph.
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
def keeping_constants(store: dict[tuple, Tensor]):
    """Keeps in ``store`` every constant that is asked for: a captured graph reads them at each replay."""
    _stores.append(store)
    try:
        yield
    finally:
        _stores.pop()


@dataclass(frozen=True, eq=False)
class CloudTable:
    """``cu_rows``, ``cloud_scene`` and ``cloud_step`` of packed clouds as numbers that the host knows.

    starts: Q + 1 row numbers. scenes, steps: Q numbers. tensors: the three on the device of the rows.
    """

    starts: tuple[int, ...]
    scenes: tuple[int, ...]
    steps: tuple[int, ...]
    tensors: tuple[Tensor, Tensor, Tensor]

    @classmethod
    def read(cls, cu_rows: Tensor, cloud_scene: Tensor, cloud_step: Tensor) -> CloudTable:
        """Waits for the device, once."""
        values = torch.cat([cu_rows, cloud_scene, cloud_step]).tolist()
        n, m = cu_rows.shape[0], cu_rows.shape[0] + cloud_scene.shape[0]
        tensors = (cu_rows, cloud_scene, cloud_step)
        return cls(tuple(values[:n]), tuple(values[n:m]), tuple(values[m:]), tensors)

    @classmethod
    def make(cls, counts: Iterable[int], scenes: Iterable[int], steps: Iterable[int], device) -> CloudTable:
        """``counts``: rows of each cloud."""
        numbers = tuple(accumulate(counts, initial=0)), tuple(scenes), tuple(steps)
        return cls(*numbers, tuple(constant(values, device) for values in numbers))

    def __len__(self) -> int:
        return len(self.scenes)

    def count(self, cloud: int) -> int:
        """Rows of a cloud."""
        return self.starts[cloud + 1] - self.starts[cloud]

    def row_runs(self, clouds: Sequence[int]) -> list[tuple[int, int]]:
        """(first row, one behind the last) of ``clouds``; clouds that follow each other share a run."""
        runs, before = [], None
        for cloud in clouds:
            begin = runs.pop()[0] if before is not None and cloud == before + 1 else self.starts[cloud]
            runs.append((begin, self.starts[cloud + 1]))
            before = cloud
        return runs


def take_runs(x: Tensor, runs: Sequence[tuple[int, int]]) -> Tensor:
    """The rows of ``runs`` one after another; a view where there is one run."""
    pieces = split_rows(x, runs)
    if len(pieces) == 1:
        return pieces[0]
    return torch.cat(pieces) if pieces else x[:0]


def split_rows(x: Tensor, runs: Sequence[tuple[int, int]]) -> list[Tensor]:
    """Views of the rows of each of ``runs``.

    Where runs ascend, the gradient of all of them is made at once; that of as many slices would be added up slice by
    slice, each with zeros to the length of ``x``.
    """
    sizes, wanted, end = [], [], 0
    for begin, until in runs:
        if begin < end:
            return [x[begin:until] for begin, until in runs]
        sizes += [begin - end] if begin > end else []
        wanted.append(len(sizes))
        sizes.append(until - begin)
        end = until
    sizes += [x.shape[0] - end] if x.shape[0] > end else []
    if len(sizes) < 2:
        return [x[begin:until] for begin, until in runs]
    pieces = x.split(sizes)
    return [pieces[i] for i in wanted]


@dataclass(frozen=True)
class Particles(TensorRecord):
    """The state of the simulator: particles with view-independent latent features.

    means: [N, 3] metres, world.            opacities: [N] in (0, 1).
    dynamic_latents: [N, Fd], change with time.   static_latents: [N, Fs], do not.
    cu_rows: int64 [Q + 1]; rows of cloud q are cu_rows[q] .. cu_rows[q + 1].
    cloud_scene, cloud_step: int64 [Q], sorted by (scene, step).
    activity: uint8 [N], 0 dynamic, 1 frozen (never moves), 2 asleep (never changes, and the dynamics does not see it;
        see gsim3d.numerics.policy). A masked-out particle is absent.
    origin: float64 [B, 3] metres, lower corner of each scene's workspace.
    world_offset: float64 [B, 3] metres, the point of each scene's world that cameras, origin and positions count from,
        so that float32 holds them; None: 0. Coordinates in edits and files are those of the world.
    quats [N, 4] (w, x, y, z), scales [N, 3] metres, sh [N, K, 3]: only in explicit models.
    orientations: [N, 4] (w, x, y, z), a rotation of the drawn appearance since encoding, from edits
        (:mod:`gsim3d.effects.edits`) and, in models with ``turning``, from the rotation of the surrounding particles.
    color_transform: [N, 3, 3], a matrix that decoded colours of latent models are multiplied by; set by edits.
    frozen_appearance: bool [N], particles whose changing latents and colours stay constant; only where an effects spec
        selects them (``appearance.held``). Resolved once at the start of a rollout and carried along.
    initial_latents: [N, Fd], the dynamic latents of frozen particles at the start of the simulation; only in models
        with ``background="relightable"``.
    velocity: [N, 3] metres a step: the last displacement of simulated particles, the mean displacement since the oldest
        step for encoded particles of the newest step, 0 elsewhere; only in models with ``velocity``.
    irradiance_gain: [N, 3], factors of the colours of simulated particles: irradiance now over irradiance at encoding;
        only in models with ``lights``.
    light_occlusion: [N, 2 L], optical depth towards each light at encoding and now
        (:func:`gsim3d.dynamics.shade.shade`), or [N, 3 L]: irradiance at encoding, n.l, and irradiance now
        (:func:`gsim3d.dynamics.daylight.daylight`); negative where unknown.
    rest_positions: [N, 3] metres, positions at the start of the simulation, the rest shape of elastic bodies; only in
        models with ``deformation``.
    body: [N, 3] metres, a place of the body that a row is a part of, the same for all its rows: where the middle of
        what is seen of it was when it was encoded (:func:`gsim3d.dynamics.bodies.bodies`); only of a model with
        ``pushes``.

    Rows of two encoded steps are not aligned (each step sees other pixels); rows of two simulated steps are.
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
    initial_latents: Tensor | None = None
    velocity: Tensor | None = None
    irradiance_gain: Tensor | None = None
    light_occlusion: Tensor | None = None
    rest_positions: Tensor | None = None
    body: Tensor | None = None
    world_offset: Tensor | None = None
    known: CloudTable | None = None  # see clouds

    ROW_FIELDS = (
        "means",
        "opacities",
        "dynamic_latents",
        "static_latents",
        "activity",
        "quats",
        "scales",
        "sh",
        "orientations",
        "color_transform",
        "frozen_appearance",
        "initial_latents",
        "velocity",
        "irradiance_gain",
        "light_occlusion",
        "rest_positions",
        "body",
    )

    @property
    def n_rows(self) -> int:
        return self.means.shape[0]

    @property
    def n_clouds(self) -> int:
        return self.cloud_scene.shape[0]

    @property
    def clouds(self) -> CloudTable:
        """The clouds as the host knows them. Only the first look at clouds given as tensors waits for the device."""
        tensors = (self.cu_rows, self.cloud_scene, self.cloud_step)
        if self.known is None or any(a is not b for a, b in zip(self.known.tensors, tensors)):
            object.__setattr__(self, "known", CloudTable.read(*tensors))
        return self.known

    def with_clouds(self, table: CloudTable, **fields) -> Particles:
        """These particles packed as ``table`` says; ``fields`` replaces what changes with it."""
        cu_rows, scene, step = table.tensors
        return dataclasses.replace(self, **fields, cu_rows=cu_rows, cloud_scene=scene, cloud_step=step, known=table)

    @property
    def latents(self) -> Tensor:
        """[N, Fd + Fs], those that change with time first."""
        return torch.cat([self.dynamic_latents, self.static_latents], 1)

    def row_fields(self) -> dict[str, Tensor]:
        """The tensors that have one row a particle, by name."""
        return {name: value for name in self.ROW_FIELDS if (value := getattr(self, name)) is not None}

    def row_cloud(self) -> Tensor:
        """int64 [N], the cloud of each row."""
        counts = self.cu_rows[1:] - self.cu_rows[:-1]
        return torch.repeat_interleave(
            torch.arange(self.n_clouds, device=counts.device), counts, output_size=self.n_rows
        )

    def row_offset(self) -> Tensor | None:
        """float64 [N, 3], the ``world_offset`` of each row's scene."""
        return None if self.world_offset is None else self.world_offset[self.cloud_scene[self.row_cloud()]]

    def select_rows(self, rows: Tensor) -> Particles:
        """Keeps ``rows`` (bool [N]); clouds stay, even where they become empty."""
        kept = torch.zeros(self.n_rows + 1, dtype=torch.int64, device=rows.device)
        kept[1:] = torch.cumsum(rows, 0)
        chosen = rows.nonzero()[:, 0]  # once: a GPU is waited for
        fields = {name: value[chosen] for name, value in self.row_fields().items()}
        return dataclasses.replace(self, **fields, cu_rows=kept[self.cu_rows])

    def select_clouds(self, clouds: Sequence[int] | Tensor) -> Particles:
        """The particles of ``clouds``, ascending."""
        chosen = clouds.tolist() if isinstance(clouds, Tensor) else list(clouds)
        table, runs = self.clouds, self.clouds.row_runs(chosen)
        table = CloudTable.make(
            (table.count(q) for q in chosen),
            (table.scenes[q] for q in chosen),
            (table.steps[q] for q in chosen),
            self.cu_rows.device,
        )
        return self.with_clouds(table, **{name: take_runs(x, runs) for name, x in self.row_fields().items()})


@dataclass(frozen=True)
class Gaussians(TensorRecord):
    """3D Gaussians, packed like the particles they came from.

    means [N, 3] metres, quats [N, 4] (w, x, y, z), scales [N, 3] metres, opacities [N] in (0, 1),
    sh [N, K, 3] coefficients of the standard 3DGS basis (K = (degree + 1)^2; colour = sum + 0.5, clamped at 0); None
    where no colour is asked for,
    cu_rows int64 [Q + 1],
    world_offset float64 [Q, 3] metres, what positions of a cloud count from; None: 0.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor | None
    cu_rows: Tensor
    world_offset: Tensor | None = None
