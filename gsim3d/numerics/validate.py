"""Validation of frames, particles and predicted steps: counts and sanitizes invalid values."""

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
from gsim3d.numerics.policy import ACTIONS, FARTHEST, LARGEST, StabilityConfig, at_most, usable_pixels
from gsim3d.numerics.report import Finding, Reading, StabilityReport, Statistics
from gsim3d.ops.validate_state import CELLS, FAST, OUTSIDE, join_records, validate_state
from gsim3d.state import ASLEEP, ATTRIBUTES, CloudTable, Particles, cached_zero

BOUNDED = {"opacities": "outside [0, 1]", "scales": "negative or not finite"}
ALWAYS = ("means", "opacities")  # validated even if unchanged
_WATCHED = "gsim3d.validated"  # metadata key of autograd nodes whose gradients are validated


class _Checks(NamedTuple):
    """Bounds and finding kinds of a validation."""

    bounds: list[tuple[float, float]]  # (lowest, highest) value of each attribute
    kinds: list[tuple[str, str, str]]  # (tensor, what, action) of every finding that the kernel counts
    neutral: list[float]  # first number of what replaces an invalid value without a previous one; the others are 0


def _checks(names: tuple[str, ...], config: StabilityConfig, max_opacity: float) -> _Checks:
    any_size = -LARGEST, LARGEST
    limits = {"means": any_size, "opacities": (0.0, max_opacity), "quats": any_size, "scales": (0.0, LARGEST)}
    bounds = [limits.get(name, (-config.max_latent, config.max_latent)) for name in names]
    action, by_rule = ACTIONS[config.on_invalid], "clamped" if config.on_invalid == "clamp" else "asleep"
    kinds = []
    for name, (_, high) in zip(names, bounds, strict=True):
        what = "not finite" if high == LARGEST else f"not finite or beyond {high:g}"
        kinds.append((f"particles.{name}", BOUNDED.get(name, what), action))
    kinds += [("particles.means", "outside the workspace", by_rule), ("particles.means", "speed limit", by_rule)]
    return _Checks(bounds, kinds, [float(name == "quats") for name in names])


_cached_checks = functools.lru_cache(maxsize=64)(_checks)


def validate_particles(
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
    """Returns ``particles`` with finite, bounded values, by the policy ``config.on_invalid``.

    Args:
        particles: any clouds.
        config: policy and limits.
        report: receives findings and, with ``previous``, statistics of every cloud.
        where: name of this call in the report.
        grid_size: edge of a cell in metres; particles outside the 2^16 cells from their scene's origin fall asleep. 0:
            no limit.
        previous: the same particles one step before. Particles that moved by more than ``config.max_speed`` fall
            asleep; invalid values are replaced by previous ones.
        changed: attributes that may differ from ``previous``; only these are validated. None: all.
        max_opacity: largest valid opacity.

    Gradients:
        Through valid particles. On the CPU, the backward pass raises if the gradient of an invalid particle is not
        finite, unless ``report`` is closed.

    Raises:
        NumericalError: particles are invalid and ``config.on_invalid`` is "raise" (on the CPU).
    """
    fields = {name: value for name, value in particles.row_fields().items() if ATTRIBUTES[name].validated}
    if changed is not None:
        fields = {name: value for name, value in fields.items() if name in changed or name in ALWAYS}
    checks = (_checks if torch.compiler.is_compiling() else _cached_checks)(tuple(fields), config, max_opacity)
    before = None if previous is None else [getattr(previous, name) for name in fields]
    clamps = config.on_invalid == "clamp"
    on_gpu = particles.means.is_cuda and not torch.compiler.is_compiling()  # asynchronous record
    clouds = {name: getattr(particles, name) for name in ("cloud_scene", "origin", "activity")}
    limits = {"grid_size": grid_size, "previous": before, "max_step": config.max_speed}
    limits["neutral"] = None if clamps else checks.neutral
    options = {**clouds, **limits, "join": not on_gpu, "check": False}
    values = [value.detach() for value in fields.values()]
    validated = validate_state(values, checks.bounds, particles.cu_rows, **options)
    if not torch.compiler.is_compiling():
        read = partial(_read, particles.clouds, where, checks, previous is not None)
        counts = _count_indices(*validated.record.shape, len(checks.kinds))
        report.record(validated.record, read, counts=counts, send=False, join=join_records if on_gpu else None)
        if validated.status.device.type == "cpu":
            if not bool(validated.status.any()):
                return particles
            if torch.is_grad_enabled():
                _validate_gradients(fields.values(), read(validated.record).findings[0], report)
    if validated.fields is not None:
        sanitized = validated.fields
        if torch.is_grad_enabled():
            sanitized = _Sanitized.apply(len(fields), validated.status, *fields.values(), *(before or ()), *sanitized)
        return _with_fields(particles, dict(zip(fields, sanitized)) | {"activity": validated.activity})
    replacements = before or [_neutral(name, particles) for name in fields]
    given, clamped = zip(fields.items(), replacements, checks.bounds, strict=True), {}
    for (name, value), replacement, (low, high) in given:
        clamped[name] = torch.where(value.isnan(), replacement, value).clamp(low, high)
    means = _clamped_means(clamped["means"], particles, validated.status, config.max_speed, grid_size, previous)
    return dataclasses.replace(particles, **clamped | {"means": means})


def validate_frames(
    frames: Frames, config: StabilityConfig, report: StabilityReport, where: str
) -> tuple[Frames, Tensor | None]:
    """Returns ``frames`` with pixels in [0, 1], and the mask bool [I, H, W] of dropped pixels (None: none).

    Invalid pixels become 0 or, with the policy "clamp", the nearest colour. With "raise" the encoder raises, which also
    validates all other fields of ``frames``.
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


_OF_SCENES = ("origin", "world_offset")  # float64 [n_scenes, 3]


def check_particles(particles: Particles, where: str, dtype: torch.dtype, widths: dict[str, int]) -> None:
    """Checks types, shapes, offsets, indices and origins, which :func:`validate_particles` does not.

    Raises InputError if a field has a wrong type, shape, device or value, for a network of ``dtype`` that reads
    ``widths`` channels of its attributes; NumericalError if an origin, or an attribute that steps do not validate, is
    not finite or too large, but on a GPU, where such particles fall asleep. Messages begin with ``where``.
    """
    if torch.compiler.is_compiling():
        return
    if not isinstance(particles, Particles):
        raise InputError(f"{where}: particles must be gsim3d.Particles; got {type(particles).__name__}")
    device = particles.means.device
    shapes = {name: (len(particles.means), *ATTRIBUTES[name].shape) for name in particles.row_fields()}
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
    if particles.actions is not None:
        _check_actions(particles, where)
    clouds, n_scenes = particles.clouds, len(particles.origin)
    starts = clouds.starts
    if starts[0] != 0 or starts[-1] != particles.n_rows or any(b < a for a, b in pairwise(starts)):
        raise InputError(f"{where}: particles.cu_rows must ascend from 0 to {particles.n_rows}, the number of rows")
    if len(clouds.steps) != len(clouds) or any(not 0 <= scene < n_scenes for scene in clouds.scenes):
        raise InputError(f"{where}: particles.cloud_scene must be in [0, {n_scenes}), rows of origin, as cloud_step")
    if device.type == "cpu":
        _check_choices(particles, where)


def _check_actions(particles: Particles, where: str) -> None:
    actions, n_scenes, device = particles.actions, len(particles.origin), particles.means.device
    positions, types, first = actions.positions, actions.types, actions.first or (0,) * n_scenes
    fits = types.dim() == 3 and positions.shape == (*types.shape, 3) and len(types) == len(first) == n_scenes
    fits = fits and 0 not in types.shape and positions.is_floating_point() and types.dtype == torch.int64
    if not fits or {positions.device, types.device} != {device}:
        got = f"{list(positions.shape)} {positions.dtype} and {list(types.shape)} {types.dtype} on {positions.device}"
        wanted = f"float positions [{n_scenes}, T, A, 3] and int64 types [{n_scenes}, T, A] on {device}, T and A > 0"
        raise InputError(f"{where}: particles.actions must have {wanted}; got {got}")
    if device.type != "cpu" and (where != "rollout" or torch.cuda.is_current_stream_capturing()):
        return  # the others are called once a step, and must not wait for the device
    finite = positions.detach().isfinite().all(-1)
    bad = ~finite | (types < -1) | (types >= len(actions.names))
    if bool(bad.any()):
        scene, entry, point = bad.nonzero()[0].tolist()
        rule = "types must be indices of names, or -1" if finite[scene, entry, point] else "positions must be finite"
        raise InputError(f"{where}: particles.actions: {rule}; scene {scene}, step {first[scene] + entry}")


def _check_choices(particles: Particles, where: str) -> None:
    if bool((particles.activity > ASLEEP).any()):
        raise InputError(f"{where}: particles.activity must be 0 (dynamic), 1 (frozen) or 2 (asleep)")
    unvalidated = [name for name, of in ATTRIBUTES.items() if not of.validated and of.dtype is None]
    for name in (*unvalidated, *_OF_SCENES):
        value = getattr(particles, name)
        if value is None:
            continue
        good = at_most(value, FARTHEST if name in _OF_SCENES else LARGEST)
        if bool(good.all()):
            continue
        row, one = int(good.logical_not().nonzero()[0]), "scene" if name in _OF_SCENES else "row"
        largest = f" and at most {FARTHEST:g} m in size" if name in _OF_SCENES else ""
        said = f"{where}: particles.{name} must be finite{largest}; {one} {row} is not"
        raise NumericalError(said, tensor=f"particles.{name}", **{one: row})


def drop_particles(particles: Particles, dropped: Tensor) -> Particles:
    """Puts the particles in the mask ``dropped`` (bool [N]) to sleep and makes them invisible."""
    opacities = torch.where(dropped, 0.0, particles.opacities)
    activity = torch.where(dropped, ASLEEP, particles.activity)
    return dataclasses.replace(particles, opacities=opacities, activity=activity)


def _read_images(frames: Frames, where: str, action: str, counts: Tensor) -> Reading:
    findings, what = [], "not finite or outside [0, 1]"
    for image, count in enumerate(counts.tolist()):
        if count:
            cloud = int(frames.cameras.image_cloud[image])
            scene, step = int(frames.cloud_scene[cloud]), int(frames.cloud_step[cloud])
            findings.append(Finding(what, where, "frames.images", action, count, None, scene, step, image))
    return Reading(findings, {})


def _read(clouds: CloudTable, where: str, checks: _Checks, moved: bool, record: Tensor) -> Reading:
    """Parses a record of the kernel."""
    findings, statistics, n_counts = [], {}, 2 * len(checks.kinds)
    for scene, step, numbers in zip(clouds.scenes, clouds.steps, record.tolist(), strict=True):
        if any(numbers[:n_counts:2]):
            for k, (name, what, action) in enumerate(checks.kinds):
                count, row = (int(number) for number in numbers[2 * k : 2 * k + 2])
                if count:
                    findings.append(Finding(what, where, name, action, count, row, scene, step))
        if moved:
            awake, energy, opacity, *corners = numbers[n_counts:]
            extent = math.dist(corners[:3], corners[3:]) if awake else 0.0
            statistics[scene, step] = Statistics(int(awake), energy, opacity, extent)
    return Reading(findings, statistics)


@functools.lru_cache(maxsize=64)
def _count_indices(n_clouds: int, n_columns: int, n_kinds: int) -> tuple[int, ...]:
    """Indices of the counts in a flattened record of the kernel."""
    return tuple(q * n_columns + 2 * k for q in range(n_clouds) for k in range(n_kinds))


def _with_fields(particles: Particles, fields: dict[str, Tensor]) -> Particles:
    """:func:`dataclasses.replace` without __init__, in a quarter of the time."""
    if torch.compiler.is_compiling():
        return dataclasses.replace(particles, **fields)
    made = object.__new__(Particles)
    vars(made).update(vars(particles), **fields)
    return made


class _Sanitized(torch.autograd.Function):
    """The kernel's sanitized copies, with gradients to the values, or to those before of rows that have them.

    ``tensors``: values (positions and opacities first), values before, if any, and copies.
    """

    @staticmethod
    def forward(ctx, n: int, status: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(status)
        ctx.set_materialize_grads(False)
        ctx.same = [value is before for value, before in zip(tensors[:n], tensors[n:-n])]
        return tensors[-n:]

    @staticmethod
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        (status,), values, before = ctx.saved_tensors, list(grads), [None] * len(ctx.same)
        stays = status & (OUTSIDE - 1 | FAST) == 0
        if grads[1] is not None:
            values[1] = torch.where(status & (OUTSIDE - 1) != 0, cached_zero(grads[1].dtype, grads[1].device), grads[1])
        for f, grad in enumerate(values):
            if grad is None or (before and ctx.same[f]):
                continue
            rows, zero = stays.reshape(-1, *[1] * (grad.dim() - 1)), cached_zero(grad.dtype, grad.device)
            values[f] = torch.where(rows, grad, zero)
            if before:
                before[f] = torch.where(rows, zero, grad)
        return None, None, *values, *before, *[None] * len(grads)


def _validate_gradients(values: Iterable[Tensor], finding: Finding, report: StabilityReport) -> None:
    """Registers hooks that raise if a gradient behind ``values`` is not finite.

    Sanitized particles have the gradient 0, which becomes NaN behind an overflowed value.
    """

    def check(gradients, _):
        if not report.is_closed and not all(bool(g.isfinite().all()) for g in gradients if g is not None):
            said = f"{finding}, {finding.action}, and gradients behind it are not finite"
            advice = "correct the inputs of its scene or leave it out, or use torch.no_grad()"
            place = {name: getattr(finding, name) for name in ("tensor", "scene", "step", "row")}
            raise NumericalError(f"{said}; {advice}", **place)

    nodes = [value.grad_fn for value in values if value.grad_fn is not None]
    while nodes:
        node = nodes.pop()
        if node.next_functions and _WATCHED not in node.metadata:  # leaves outlive their graph
            node.metadata[_WATCHED] = True
            node.register_hook(check)
            nodes += [behind for behind, _ in node.next_functions if behind is not None]


def _neutral(name: str, particles: Particles) -> Tensor:
    """Replacements of invalid values of an attribute without previous values."""
    value = getattr(particles, name)
    if name == "means":
        return particles.row_origin().to(value)
    neutral = torch.zeros_like(value)
    if name == "quats":
        neutral[:, 0] = 1
    return neutral


def _clamped_means(
    means: Tensor, particles: Particles, status: Tensor, max_speed: float, grid_size: float, previous: Particles | None
) -> Tensor:
    """Clamps positions to the speed limit and to the workspace."""
    if previous is not None:
        step = means - previous.means
        length = step.double().norm(dim=1, keepdim=True)
        share = (max_speed / length.clamp(min=max_speed)).to(step)
        means = torch.where(status[:, None] & FAST != 0, previous.means + share * step, means)
    if grid_size > 0:
        origin = particles.row_origin()
        inside = (means.double() - origin).clamp(0, (CELLS - 0.5) * grid_size)
        outside = status[:, None] & (OUTSIDE | FAST | 1) != 0
        means = torch.where(outside, (origin + inside).to(means), means)
    return means
