"""Where data enters the simulator or leaves a step: what cannot be used is found, counted and handled by the policy."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Collection, Iterable
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.errors import InputError, NumericalError
from gsim3d.numerics.policy import (
    ACTIONS,
    FARTHEST,
    LARGEST,
    Finding,
    Reading,
    Sentinels,
    StabilityConfig,
    StabilityReport,
    at_most,
    usable_pixels,
)
from gsim3d.ops.validate_state import CELLS, FAST, OUTSIDE, join_records, validate_state
from gsim3d.state import ASLEEP, ATTRIBUTES, CloudTable, Particles

BOUNDED = {"opacities": "outside [0, 1]", "scales": "negative or not finite"}
ALWAYS = ("means", "opacities")  # are looked at, changed or not


_WATCHED = "gsim3d.validated"  # a node of a graph whose gradients are looked at


class _Looks(NamedTuple):
    """How a guard looks at the fields of particles.

    kinds: (tensor, what is wrong, action) of every kind that validate_state counts.
    neutral: first number of what stands in for a row that nobody knows, others are 0.
    """

    bounds: list[tuple[float, float]]
    kinds: list[tuple[str, str, str]]
    neutral: list[float]


def _looks_at(names: tuple[str, ...], config: StabilityConfig, max_opacity: float) -> _Looks:
    limits = {
        "means": (-LARGEST, LARGEST),
        "opacities": (0.0, max_opacity),
        "quats": (-LARGEST, LARGEST),
        "scales": (0.0, LARGEST),
    }
    bounds = [limits.get(name, (-config.max_latent, config.max_latent)) for name in names]
    action, by_rule = ACTIONS[config.on_invalid], "clamped" if config.on_invalid == "clamp" else "asleep"
    kinds = [(f"particles.{name}", BOUNDED.get(name) or _what(high), action) for name, (_, high) in zip(names, bounds)]
    kinds += [("particles.means", "outside the workspace", by_rule), ("particles.means", "speed limit", by_rule)]
    return _Looks(bounds, kinds, [float(name == "quats") for name in names])


_recent_looks = functools.lru_cache(maxsize=64)(_looks_at)


def guard_particles(
    particles: Particles,
    config: StabilityConfig,
    report: StabilityReport,
    where: str,
    *,
    grid_size: float = 0.0,
    previous: Particles | None = None,
    changed: Collection[str] | None = None,
    max_opacity: float = 1.0,
) -> Particles:
    """``particles`` with finite, bounded numbers only; rows that had others are handled by ``config.on_invalid``.

    Args:
        particles: any clouds.
        config: policy and limits.
        report: is told of every such row and, with ``previous``, of the sentinels of every cloud.
        where: what the report calls this place.
        grid_size: metres, cells in which the dynamics sees them: a row outside the 2^16 cells from its scene's origin
            falls asleep; 0: there is no such limit.
        previous: the same rows one step before: a row that moved further than ``config.max_speed`` falls asleep, and
            rows that cannot be used return to it.
        changed: fields that differ from ``previous``; others are not looked at again. None: all.
        max_opacity: larger ones count as out of range.
    Gradients: through all rows that stay as they are. On the CPU a backward pass raises where a gradient behind rows
        that did not stay is not finite, unless ``report`` is closed.
    Raises:
        NumericalError: ``config.on_invalid`` is "raise", on the CPU.
    """
    fields = {
        name: value
        for name, value in particles.row_fields().items()
        if ATTRIBUTES[name].validated and (changed is None or name in changed or name in ALWAYS)
    }
    looks = (_looks_at if torch.compiler.is_compiling() else _recent_looks)(tuple(fields), config, max_opacity)
    before = None if previous is None else [getattr(previous, name) for name in fields]
    clamps = config.on_invalid == "clamp"
    is_told = particles.means.is_cuda and not torch.compiler.is_compiling()  # the report, later
    # the copies that the kernel mends carry no gradients
    in_kernel = not clamps and not (torch.is_grad_enabled() and _have_gradients(fields.values(), before or ()))
    validated = validate_state(
        list(fields.values()),
        looks.bounds,
        particles.cu_rows,
        cloud_scene=particles.cloud_scene,
        origin=particles.origin,
        activity=particles.activity,
        grid_size=grid_size,
        previous=before,
        max_step=config.max_speed,
        neutral=looks.neutral if in_kernel else None,
        join=not is_told,
        check=False,
    )
    if not torch.compiler.is_compiling():
        read = partial(_read, particles.clouds, where, looks, previous is not None)
        counts = _places_of_counts(*validated.record.shape, len(looks.kinds))
        report.record(validated.record, read, counts=counts, at_once=False, join=join_records if is_told else None)
        if validated.status.device.type == "cpu":
            if not bool(validated.status.any()):
                return particles
            if torch.is_grad_enabled():
                _watch_gradients(fields.values(), read(validated.record).findings[0], report)
    if validated.fields is not None:
        return _with_rows(particles, dict(zip(fields, validated.fields)) | {"activity": validated.activity})
    mend = _clamp if clamps else _put_to_sleep
    return mend(particles, fields, looks.bounds, validated.status, config, grid_size, previous)


def guard_frames(
    frames: Frames, config: StabilityConfig, report: StabilityReport, where: str
) -> tuple[Frames, Tensor | None]:
    """``frames`` with pixels in [0, 1], and bool [I, H, W]: those that must not become particles (None: all may).

    Numbers that are no colour are 0, where the policy is "clamp" the nearest one, and then particles like any other.
    "raise" leaves them to the encoder, as every policy does with all other fields of ``frames``: these raise always.
    """
    images = frames.images
    if config.on_invalid == "raise":
        return frames, None
    usable = usable_pixels(images)
    bad = (~usable).any(1)
    report.record(bad.sum((1, 2)), partial(_read_images, frames, where, ACTIONS[config.on_invalid]))
    nearest = images.nan_to_num(0.0, 1.0, 0.0).clamp(0, 1) if config.on_invalid == "clamp" else torch.zeros_like(images)
    images = torch.where(usable, images, nearest)
    return dataclasses.replace(frames, images=images), bad if config.on_invalid == "drop" else None


_OF_SCENES = ("origin", "world_offset")  # float64, one row a scene


def check_particles(particles: Particles, where: str, dtype: torch.dtype, widths: dict[str, int]) -> None:
    """Looks at what :func:`guard_particles` does not: types, shapes, offsets, indices, origins and choices.

    Args:
        where: what the message calls this place.
        dtype: of the network, and so of the rows.
        widths: channels of fields that the network reads.
    Raises:
        InputError: the message names the field and what it must be.
        NumericalError: an origin, or what is remembered of a row, is not finite or too far; on a GPU these are not
            looked at: rows far from their origin sleep.
    """
    if torch.compiler.is_compiling():
        return
    if not isinstance(particles, Particles):
        raise InputError(f"{where}: particles must be gsim3d.Particles; got {type(particles).__name__}")
    rows, device = particles.row_fields(), particles.means.device
    shapes = {name: (len(particles.means), *ATTRIBUTES[name].shape) for name in rows}
    shapes |= {name: (len(particles.means), width) for name, width in widths.items()}
    shapes |= {"cu_rows": (len(particles.cloud_scene) + 1,), "cloud_scene": (None,), "cloud_step": (None,)}
    shapes["origin"] = (None, 3)
    if particles.world_offset is not None:
        shapes["world_offset"] = (len(particles.origin), 3)
    for name, shape in shapes.items():
        value = getattr(particles, name)
        wanted = torch.int64 if name.startswith(("cu_", "cloud_")) else dtype
        wanted = ATTRIBUTES[name].dtype or wanted if name in ATTRIBUTES else wanted
        if name in _OF_SCENES:
            wanted = torch.float32 if getattr(value, "dtype", None) == torch.float32 else torch.float64
        is_one = isinstance(value, Tensor) and value.dtype == wanted
        if not is_one or value.dim() != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape)):
            got = f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            sizes = ", ".join("any" if n is None else str(n) for n in shape)
            raise InputError(f"{where}: particles.{name} must be {wanted} [{sizes}]; got {got}")
        if value.device != device:
            raise InputError(f"{where}: particles.{name} is on {value.device}, particles.means on {device}")
    clouds, n_scenes = particles.clouds, len(particles.origin)
    starts = clouds.starts
    if starts[0] != 0 or starts[-1] != particles.n_rows or any(b < a for a, b in pairwise(starts)):
        raise InputError(f"{where}: particles.cu_rows must ascend from 0 to {particles.n_rows}, the number of rows")
    if len(clouds.steps) != len(clouds) or any(not 0 <= scene < n_scenes for scene in clouds.scenes):
        raise InputError(f"{where}: particles.cloud_scene must be in [0, {n_scenes}), rows of origin, as cloud_step")
    if device.type == "cpu":
        _check_choices(particles, where)


def _check_choices(particles: Particles, where: str) -> None:
    if bool((particles.activity > ASLEEP).any()):
        raise InputError(f"{where}: particles.activity must be 0 (dynamic), 1 (frozen) or 2 (asleep)")
    unwatched = (name for name, attribute in ATTRIBUTES.items() if not attribute.validated and attribute.dtype is None)
    for name in (*unwatched, *_OF_SCENES):
        value = getattr(particles, name)
        if value is None:
            continue
        good = at_most(value, FARTHEST if name in _OF_SCENES else LARGEST)
        if bool(good.all()):
            continue
        row, one = int(good.logical_not().nonzero()[0]), "scene" if name in _OF_SCENES else "row"
        largest = f" and at most {FARTHEST:g} m in size" if name in _OF_SCENES else ""
        raise NumericalError(
            f"{where}: particles.{name} must be finite{largest}; {one} {row} is not",
            tensor=f"particles.{name}",
            **{one: row},
        )


def drop_rows(particles: Particles, rows: Tensor) -> Particles:
    """``particles`` of which ``rows`` (bool [N]) sleep and are not drawn."""
    return dataclasses.replace(
        particles,
        opacities=torch.where(rows, 0.0, particles.opacities),
        activity=torch.where(rows, ASLEEP, particles.activity),
    )


def _read_images(frames: Frames, where: str, action: str, counts: Tensor) -> Reading:
    findings, what = [], "not finite or outside [0, 1]"
    for image, count in enumerate(counts.tolist()):
        if count:
            cloud = int(frames.cameras.image_cloud[image])
            scene, step = int(frames.cloud_scene[cloud]), int(frames.cloud_step[cloud])
            findings.append(Finding(what, where, "frames.images", action, count, None, scene, step, image))
    return Reading(findings, {})


def _what(high: float) -> str:
    return "not finite" if high == LARGEST else f"not finite or beyond {high:g}"


def _read(clouds: CloudTable, where: str, looks: _Looks, moved: bool, record: Tensor) -> Reading:
    """What a record of validate_state says."""
    findings, sentinels, n_counts = [], {}, 2 * len(looks.kinds)
    for scene, step, numbers in zip(clouds.scenes, clouds.steps, record.tolist(), strict=True):
        if any(numbers[:n_counts:2]):
            for k, (name, what, action) in enumerate(looks.kinds):
                count, row = (int(number) for number in numbers[2 * k : 2 * k + 2])
                if count:
                    findings.append(Finding(what, where, name, action, count, row, scene, step))
        if moved:
            awake, energy, opacity, *corners = numbers[n_counts:]
            extent = math.dist(corners[:3], corners[3:]) if awake else 0.0
            sentinels[scene, step] = Sentinels(int(awake), energy, opacity, extent)
    return Reading(findings, sentinels)


@functools.lru_cache(maxsize=64)
def _places_of_counts(n_clouds: int, n_columns: int, n_kinds: int) -> tuple[int, ...]:
    """Where a record of validate_state holds how many rows were bad."""
    return tuple(q * n_columns + 2 * k for q in range(n_clouds) for k in range(n_kinds))


def _with_rows(particles: Particles, fields: dict[str, Tensor]) -> Particles:
    """dataclasses.replace, which calls __init__, in a quarter of the time."""
    if torch.compiler.is_compiling():
        return dataclasses.replace(particles, **fields)
    made = object.__new__(Particles)
    vars(made).update(vars(particles), **fields)
    return made


def _have_gradients(*groups: Iterable[Tensor]) -> bool:
    return any(value.requires_grad for group in groups for value in group)


def _watch_gradients(values: Iterable[Tensor], finding: Finding, report: StabilityReport) -> None:
    """Makes a backward pass through ``values`` raise where what it computes is not finite.

    Rows that were mended have a gradient of 0, which becomes NaN where it meets what overflowed before them.
    """

    def look(gradients, _):
        if not report.is_closed and not all(bool(g.isfinite().all()) for g in gradients if g is not None):
            raise NumericalError(
                f"{finding}, {finding.action}, and gradients behind it are not finite; mend the inputs of its scene or "
                "leave it out, or go on under torch.no_grad()",
                tensor=finding.tensor,
                scene=finding.scene,
                step=finding.step,
                row=finding.row,
            )

    nodes = [value.grad_fn for value in values if value.grad_fn is not None]
    while nodes:
        node = nodes.pop()
        if node.next_functions and _WATCHED not in node.metadata:  # leaves outlive their graph
            node.metadata[_WATCHED] = True
            node.register_hook(look)
            nodes += [behind for behind, _ in node.next_functions if behind is not None]


def _neutral(name: str, particles: Particles) -> Tensor:
    """What stands in for a value that nobody knows."""
    value = getattr(particles, name)
    if name == "means":
        return particles.origin[particles.cloud_scene[particles.row_cloud()]].to(value)
    neutral = torch.zeros_like(value)
    if name == "quats":
        neutral[:, 0] = 1
    return neutral


def _put_to_sleep(particles, fields, bounds, status, config, grid_size, previous) -> Particles:
    unusable, stays = status & (OUTSIDE - 1) != 0, status & (OUTSIDE - 1 | FAST) == 0
    mended = {}
    for name, value in fields.items():
        before = _neutral(name, particles) if previous is None else getattr(previous, name)
        if before is not value:
            mended[name] = torch.where(stays.reshape(-1, *[1] * (value.dim() - 1)), value, before)
    opacities = mended.get("opacities", particles.opacities)
    mended["opacities"] = torch.where(unusable, 0.0, opacities)
    mended["activity"] = torch.where(status == 0, particles.activity, ASLEEP)
    return dataclasses.replace(particles, **mended)


def _clamp(particles, fields, bounds, status, config, grid_size, previous) -> Particles:
    mended = {}
    for (name, value), (low, high) in zip(fields.items(), bounds, strict=True):
        before = _neutral(name, particles) if previous is None else getattr(previous, name)
        mended[name] = torch.where(value.isnan(), before, value).clamp(low, high)
    if previous is not None:
        step = mended["means"] - previous.means
        length = step.double().norm(dim=1, keepdim=True)
        share = (config.max_speed / length.clamp(min=config.max_speed)).to(step)
        mended["means"] = torch.where(status[:, None] & FAST != 0, previous.means + share * step, mended["means"])
    if grid_size > 0:
        origin = particles.origin[particles.cloud_scene[particles.row_cloud()]]
        inside = (mended["means"].double() - origin).clamp(0, (CELLS - 0.5) * grid_size)
        outside = status[:, None] & (OUTSIDE | FAST | 1) != 0
        mended["means"] = torch.where(outside, (origin + inside).to(mended["means"]), mended["means"])
    return dataclasses.replace(particles, **mended)
