"""3D Gaussian splatting: packed scenes, times and views rendered in one call."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d._core import constants
from gsim3d.cameras import Cameras
from gsim3d.errors import GradientError, check_one_of
from gsim3d.numerics.policy import OnInvalid, check_on_invalid
from gsim3d.numerics.report import Finding, Reading, StabilityReport
from gsim3d.ops._arguments import check_floating, check_numbers, check_real, check_tensors, check_whole, within_memory
from gsim3d.ops._register import call, expanded, fakes, one_by_one, register_autocast, register_gradients

OP = "rasterize_gaussians"
LARGEST: float = constants["raster_largest"]
CUTOFFS: dict[str, int] = constants["raster_cutoffs"]
JACOBIANS: dict[str, int] = constants["raster_jacobians"]
FAULTS: tuple[str, ...] = constants["raster_faults"]
TILE = 16  # pixels, kTile of csrc/gsim3d/raster/raster_math.h
ROW_FAULTS: int = constants["raster_row_faults"]  # the first faults are of rows


class Rendering(NamedTuple):
    """Images of one call; of a simulator, those that its plan asks for, and None for the others.

    Attributes:
        color: [I, H, W, 3].
        alpha: [I, H, W] in [0, 1), how much of the background is hidden.
        depth: [I, H, W] metres, sum of weight * camera z (divide by ``alpha`` for a mean).
        features: [I, H, W, F], or None.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    features: Tensor | None


def rasterize_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    cameras: Cameras,
    *,
    sh: Tensor | None = None,
    colors: Tensor | None = None,
    features: Tensor | None = None,
    background: Tensor | None = None,
    cu_rows: Tensor | None = None,
    active: Tensor | None = None,
    near_plane: float = 0.01,
    cutoff: str = "exact",
    jacobian: str = "exact",
    on_invalid: OnInvalid = "raise",
    report: StabilityReport | None = None,
) -> Rendering:
    """Renders clouds of 3D Gaussians into pinhole images.

    Image i shows cloud ``cameras.image_cloud[i]``. At a pixel with centre p, Gaussian n of that cloud has
    ``alpha_n = min(0.99, opacity_n exp(-(p - mu_n)^T Sigma_n^-1 (p - mu_n) / 2))``, where ``mu_n`` is the projected
    mean and ``Sigma_n`` the projected covariance plus 0.3 px^2 on its diagonal. Where it is at least 1/255, it adds
    ``alpha_n T_n`` times its colour, camera z and features; ``T_n`` is the product of ``1 - alpha`` over the Gaussians
    in front (order of camera z, ties by row). A pixel ends before ``T`` would fall below 1e-4; then the background is
    added.

    Args:
        means: [N, 3] metres, world; float32 or float64.
        quats: [N, 4] (w, x, y, z), normalised inside; shorter than 1e-6 counts as the identity and has no gradient.
        scales: [N, 3] metres, standard deviations along the rotated axes, not negative.
        opacities: [N] in [0, 1].
        cameras: I images. ``viewmats`` and ``Ks`` are cast to the dtype of ``means``; ``Ks`` may hold a skew; ``near``
            and ``far`` are not read.
        sh: [N, K, 3], K = 1, 4, 9 or 16 coefficients of real spherical harmonics in the standard 3DGS basis and order;
            colour = sum + 0.5, clamped at 0. The direction is W^T (W mean + t), W and t from ``viewmats``.
        colors: [N, 3], in place of ``sh``. Both may be float16, as are their gradients then.
        features: [N, F] extra channels, any F.
        background: [3] or [I, 3]; default black.
        cu_rows: int64 [Q + 1], rows of cloud q are cu_rows[q] .. cu_rows[q + 1]; default one cloud.
        active: bool [I, H, W], pixels that are wanted, such as those that a loss reads; default all. A tile of 16 x 16
            pixels without any shows its background, as if no Gaussian was there; the others have the same bits.
        near_plane: metres, positive; Gaussians whose centre is not beyond it are left out.
        cutoff: "exact"; "tile3sigma" also drops pixels outside the 16 x 16 tiles that a square of 3 standard deviations
            touches, as the published model's renderer does; "smooth" fades alpha between 2/255 and 1/255, so that the
            result is differentiable everywhere: for tests of gradients.
        jacobian: where the projection of a Gaussian centred outside of the image is linearised. "exact": at its centre,
            so an image is what a larger one of the same camera has there; "clamped": at most 0.15 of the image outside
            of it, as 3DGS and gsplat do, and models trained so expect.
        on_invalid: what happens to a row that cannot be used (:mod:`gsim3d.numerics.policy`). "raise": an error on the
            CPU, left out on a GPU; "drop": left out, its gradients are 0; "clamp": bounded, NaN counts as 0
            (rotation: identity).
        report: counts such rows by image; on a GPU its ``check()`` raises what "raise" could not. Without one a GPU
            does not count. Under ``torch.func`` nothing is counted, and such rows are left out.
    Returns:
        Rendering, dtype of ``means``.
    Gradients:
        means, quats, scales, opacities, sh or colors, features, background, ``cameras.viewmats`` (its 12 upper
        entries taken as free numbers): once, also in forward mode and under ``torch.func``; on the CPU twice. A
        Gaussian gets none from a pixel where its alpha is cut to 0.99, and its colour none where it was clamped at 0.
    Determinism:
        equal bits for any number of threads, forward and backward; on a GPU from run to run.
    GPU: nothing waits for the device. Its memory is made for Gaussians of a few pixels and clouds shown by equally many
        images; what exceeds it is rendered in further groups of images, slower.
    Raises:
        NumericalError: ``on_invalid`` is "raise" on the CPU, and a number is not finite or beyond 1e15 (rotations:
            of any length), an opacity outside [0, 1], a scale negative, or a projection overflows; names argument, row
            and camera.
        ValueError: a shape, dtype, offset or camera is not as above. On a GPU an image whose camera or cloud is not
            shows its background, and a background that is not finite is black.
    Source:
        Zwicker et al. 2002 (EWA splatting), Kerbl et al. 2023 (3D Gaussian splatting); conventions of gsplat.

    Example:
        >>> from gsim3d.cameras import Cameras
        >>> K = torch.tensor([[[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]]])
        >>> one, first = torch.ones(1), torch.zeros(1, dtype=torch.int64)
        >>> cameras = Cameras(torch.eye(4)[None], K, 0.1 * one, 10 * one, first, width=8, height=8)
        >>> means, quats = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        >>> image = rasterize_gaussians(means, quats, 0.2 * torch.ones(1, 3), one, cameras, colors=torch.ones(1, 3))
        >>> image.color.shape, bool(image.alpha[0, 4, 4] > 0.7)
        (torch.Size([1, 8, 8, 3]), True)
    """
    compiling = torch.compiler.is_compiling()
    rows = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    if not compiling:
        optional = {"sh": sh, "colors": colors, "features": features, "background": background, "cu_rows": cu_rows}
        _check(rows, optional | {"active": active}, cameras, near_plane)
    name, color = _check_choices(sh, colors, cutoff, jacobian, on_invalid)
    n, n_images = means.shape[0], cameras.viewmats.shape[0]
    real = torch.float64 if means.dtype == torch.float64 else torch.float32
    rows[name] = color.to(real) if color.dtype == torch.float16 else color
    rows["features"] = means.new_empty(n, 0) if features is None else features
    if on_invalid == "clamp":
        _check_rows(rows)
        rows = _clamped(rows, report)
    cu_rows = torch.tensor([0, n], device=means.device) if cu_rows is None else cu_rows
    watch = not compiling and _is_watched(on_invalid, report, means)
    args = (
        *(*rows.values(), _of_each_image(background, n_images, means, real), cameras.viewmats.to(real)),
        *(cameras.Ks.to(real), cameras.image_cloud, cu_rows, cameras.width, cameras.height, near_plane),
        *(CUTOFFS[cutoff], JACOBIANS[jacobian]),
        *sizes_of_state(means, n_images, cu_rows.shape[0] - 1, cameras.width, cameras.height),
        *(watch, *(() if active is None else [_tiles_with(active)])),
    )
    size = "" if compiling else f"cameras.width={cameras.width}, cameras.height={cameras.height}"
    out = within_memory(OP, size, call, OP, *args)
    if watch:
        action = "error" if on_invalid == "raise" else "dropped"
        read = partial(_unusable, names=(*rows, "scales", "scales", "cameras"), action=action)
        (StabilityReport() if report is None else report).record(out[7], read, counts=range(0, out[7].numel(), 2))
    return Rendering(out[0], out[1], out[2], None if features is None else out[3])


def _tiles_with(active: Tensor) -> Tensor:
    """bool [I, tiles by column, tiles by row] of pixels [I, H, W]: whether any of a tile's is true."""
    height, width = active.shape[1:]
    tiles = F.pad(active, (0, -width % TILE, 0, -height % TILE))
    return tiles.unflatten(2, (-1, TILE)).unflatten(1, (-1, TILE)).any((2, 4))


def _is_watched(on_invalid: OnInvalid, report: StabilityReport | None, means: Tensor) -> bool:
    """Whether rows that cannot be used are counted; under ``torch.func`` there are no numbers to read."""
    wanted = report is not None or (on_invalid == "raise" and means.device.type == "cpu")
    return wanted and not torch._C._are_functorch_transforms_active()


def _of_each_image(background: Tensor | None, n_images: int, means: Tensor, dtype: torch.dtype) -> Tensor:
    """[I, 3]; black where there is no background."""
    if background is None:
        return means.new_zeros(n_images, 3, dtype=dtype)
    return background.expand(n_images, -1) if background.dim() == 1 else background


def _unusable(numbers: Tensor, names: Sequence[str], action: str) -> Reading:
    """What the op's last output says: of every image, how many rows were left out, and the first with its faults."""
    findings = []
    for camera, (count, first) in enumerate(numbers.tolist()):
        if count:
            fault = next(k for k in range(len(FAULTS)) if first >> k & 1)
            row = first >> len(FAULTS) if fault < ROW_FAULTS else None
            findings.append(Finding(FAULTS[fault], OP, names[fault], action, count, row, camera=camera))
    return Reading(findings, {})


def _clamped(rows: dict[str, Tensor], report: StabilityReport | None) -> dict[str, Tensor]:
    """Rows with finite numbers in range, counted."""
    bounded, bad = {}, []
    for name, value in rows.items():
        largest = min(LARGEST, torch.finfo(value.dtype).max)
        neutral = torch.zeros_like(value)
        if name == "quats":
            neutral[:, 0] = 1
        bounds = {"opacities": (0.0, 1.0), "scales": (0.0, largest)}
        bounded[name] = torch.where(value.isnan(), neutral, value).clamp(*bounds.get(name, (-largest, largest)))
        bad.append((bounded[name] != value.detach())[..., None].flatten(1).any(1))
    if report is not None and not torch.compiler.is_compiling():
        counts = torch.stack(bad).sum(1)
        report.record(counts, partial(_counted, names=list(rows)))
    return bounded


def _counted(counts: Tensor, names: list[str]) -> Reading:
    what, found = "not finite or out of range", zip(names, counts.tolist(), strict=True)
    return Reading([Finding(what, OP, name, "clamped", n) for name, n in found if n], {})


def _check(rows: dict[str, Tensor], optional: dict[str, Tensor | None], cameras: Cameras, near_plane: float) -> None:
    """Types, and the shapes that are read before the kernel checks them."""
    optional = {name: value for name, value in optional.items() if value is not None}
    check_real(OP, near_plane=near_plane)
    check_scene(OP, rows | optional, cameras)
    active, size = optional.get("active"), (len(cameras.viewmats), cameras.height, cameras.width)
    if active is not None and (active.shape != size or active.dtype != torch.bool):
        raise ValueError(f"{OP}: active must be bool [I, H, W] = {list(size)}; got {active.dtype} {list(active.shape)}")


def check_scene(op: str, tensors: dict[str, Tensor], cameras: Cameras, **sizes: int) -> None:
    """Types of all arguments, and numbers of dimensions that are read before a kernel checks them."""
    if not isinstance(cameras, Cameras):
        raise TypeError(f"{op}: cameras must be gsim3d.Cameras; got {type(cameras).__name__}")
    tensors = tensors | {f"cameras.{name}": getattr(cameras, name) for name in ("viewmats", "Ks", "image_cloud")}
    check_tensors(op, **tensors)
    check_floating(op, means=tensors["means"])
    check_whole(op, **sizes, **{"cameras.width": cameras.width, "cameras.height": cameras.height})
    shapes = {"means": "[N, 3]", "cameras.viewmats": "[I, 4, 4]", "cameras.Ks": "[I, 3, 3]", "cu_rows": "[Q + 1]"}
    for name, shape in shapes.items():
        if (value := tensors.get(name)) is not None and value.dim() != shape.count(",") + 1:
            raise ValueError(f"{op}: {name} must be {shape}; got {list(value.shape)}")
    check_last_rows(op, cameras.viewmats, cameras.Ks)


def check_last_rows(op: str, viewmats: Tensor, Ks: Tensor) -> None:
    """Raises NumericalError where matrices on the CPU have another last row than 0, 0, (0,) 1."""
    rows = {"viewmats[..., 3, :3]": viewmats[..., 3:4, :3], "Ks[..., 2, :2]": Ks[..., 2:3, :2]}
    check_numbers(op, largest_of=1e-3, **{f"{name} (0 unless transposed)": row for name, row in rows.items()})


def _check_choices(
    sh: Tensor | None, colors: Tensor | None, cutoff: str, jacobian: str, on_invalid: OnInvalid
) -> tuple[str, Tensor]:
    """Returns the name and the tensor of colours."""
    check_on_invalid(on_invalid)
    if (sh is None) == (colors is None):
        raise ValueError(f"{OP}: give one of sh and colors")
    check_one_of(f"{OP}: cutoff", cutoff, CUTOFFS)
    check_one_of(f"{OP}: jacobian", jacobian, JACOBIANS)
    name, color, shape = ("sh", sh, "[N, K, 3]") if colors is None else ("colors", colors, "[N, 3]")
    if color.dim() != shape.count(",") + 1:
        raise ValueError(f"{OP}: {name} must be {shape}; got {list(color.shape)}")
    return name, color  # type: ignore[return-value]  # one of them is given


def _check_rows(rows: dict[str, Tensor]) -> None:
    """Numbers that policies may change must be numbers, and rows of ``means``."""
    n = rows["means"].shape[0]
    wanted = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, value in rows.items():
        if not value.is_floating_point():
            raise ValueError(f"{OP}: {name} must be float32 or float64; got {value.dtype}")
        if value.shape != wanted.get(name, (n, *value.shape[1:])):
            raise ValueError(f"{OP}: {name} must have N={n} rows as means; got {list(value.shape)}")


def _tiles(n_images, width, height):
    return n_images * ((width + TILE - 1) // TILE) * ((height + TILE - 1) // TILE)


def sizes_of_state(means: Tensor, n_images: int, n_clouds: int, width: int, height: int) -> tuple[int, int, int]:
    """(max_pairs, max_entries, max_slots): RasterLimits of csrc/gsim3d/raster/raster.h. Exact for clouds shown by
    equally many images; about twice what Gaussians of a few pixels need."""
    if means.device.type != "cuda":
        return 0, 0, 0
    n, tiles = means.shape[0], _tiles(n_images, width, height)
    pairs = max(n, min(n * -(-n_images // max(1, n_clouds)), 2**25))
    entries = min(pairs + pairs // 4 + 1024 * tiles, 2**30)
    slots = min(pairs + pairs // 2 + 2048 * tiles, 2**30)
    return pairs, max(n, entries), max(4 * n, slots)


def state_bytes(
    means: Tensor, n_images: int, n_clouds: int, width: int, height: int, max_pairs: int, max_slots: int
) -> int:
    """raster_state_bytes of csrc/gsim3d/raster/raster.h."""
    if means.device.type != "cuda":
        return 0
    real, tiles = means.element_size(), _tiles(n_images, width, height)
    view = 112 if real == 4 else 200
    lists = (8 * max_pairs, 12 * real * max_pairs, 4 * max_pairs, 4 * tiles, 32 * tiles, 4 * max_slots)
    return sum((n + 63) // 64 * 64 for n in (64, view * n_images, 16 * n_clouds, 4 * n_images, *lists))


def empty_images(means: Tensor, n_images: int, width: int, height: int, n_features: int, n_bytes: int) -> list[Tensor]:
    """Color, alpha, depth, features, transmittance, last row of each pixel and the state: results of a rasterizer."""
    shape = (n_images, height, width)
    floats = [means.new_empty(*shape, *more) for more in ((3,), (), (), (n_features,), ())]
    return [*floats, means.new_empty(shape, dtype=torch.int32), means.new_empty(n_bytes, dtype=torch.uint8)]


def grads_of_images(grads: Sequence[Tensor | None], transmittance: Tensor, n_features: int) -> list[Tensor]:
    """Gradients of color, alpha, depth and features; zeros where there is none."""
    shape, given = transmittance.shape, zip(grads, ((3,), (), (), (n_features,)))
    return [transmittance.new_zeros(*shape, *size) if grad is None else grad for grad, size in given]


def _images(means, quats, scales, opacities, color, features, background, viewmats, *rest):
    _, _, cu_rows, width, height, _, _, _, *sizes, watch = rest[:12]  # others do not count
    n_images = viewmats.shape[0]
    state = state_bytes(means, n_images, cu_rows.shape[0] - 1, width, height, sizes[0], sizes[2])
    unusable = means.new_empty(n_images if watch else 0, 2, dtype=torch.int64)
    return *empty_images(means, n_images, width, height, features.shape[1], state), unusable


def _gradients(grad_color, grad_alpha, grad_depth, grad_features, transmittance, last, state, *inputs):
    shapes = [x.shape for x in inputs[:7]] + [(inputs[7].shape[0] if inputs[19] else 0, 4, 4)]
    return tuple(inputs[0].new_empty(shape) for shape in shapes)


TANGENT, SECOND = f"{OP}_tangent", f"{OP}_backward_tangent"  # of images; of images and gradients, along a direction
fakes(**{OP: _images, f"{OP}_backward": _gradients})
fakes(**{TANGENT: lambda *x: tuple(empty_images(x[9], x[16].shape[0], x[20], x[21], x[14].shape[1], 0)[:4])})
fakes(**{SECOND: lambda *inputs: tuple(x.new_empty(x.shape) for x in (*inputs[19:23], *inputs[:8]))})


def _setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)  # else what is kept for the backward pass gets a gradient of zeros as large
    ctx.mark_non_differentiable(*output[4:])
    ctx.save_for_backward(*output[4:7], *inputs[:11], *inputs[20:])
    ctx.options = inputs[11:19]


def _backward(ctx, *grads):
    saved = ctx.saved_tensors  # read once: a checkpoint gives them once
    images = grads_of_images(grads, saved[0], saved[8].shape[1])
    viewmats_grad = ctx.needs_input_grad[7]
    *grads, viewmats = call(f"{OP}_backward", *images, *saved[:14], *ctx.options, viewmats_grad, *saved[14:])
    return (*grads, viewmats if viewmats_grad else None, *[None] * 13)


def _folded(k: int, size: int, inputs: Sequence, is_batched: Sequence[bool]) -> list:
    """Inputs of a batch as those of a single call, scenes one after the other; input ``k`` is the first of a scene."""
    rows = expanded(size, inputs, is_batched)
    means, (image_cloud, cu_rows, *image) = rows[k], rows[k + 9 : k + 13]
    n_clouds, entry = cu_rows.shape[1] - 1, torch.arange(size, device=means.device)[:, None]
    ends = (cu_rows[:, 1:] + means.shape[1] * entry).flatten()
    rows = [x.flatten(0, 1) if isinstance(x, Tensor) else x for x in rows]
    rows[k + 9 : k + 11] = (image_cloud + n_clouds * entry).flatten(), torch.cat([cu_rows[0, :1], ends])
    rows[k + 16 : k + 19] = sizes_of_state(rows[k], len(rows[k + 7]), size * n_clouds, *image)
    return rows


def _batched(size, inputs, is_batched):
    *images, state, unusable = call(OP, *_folded(0, size, inputs, is_batched))
    images = [x.unflatten(0, (size, -1)) for x in images]
    return (*images, state.expand(size, -1), unusable.reshape(size, -1, 2))  # the state is of all of them


def _kept_batched(op, k, size, inputs, is_batched):
    """Of an op whose input ``k`` is the state, with the scene behind it."""
    if not is_batched[k]:  # the state is of one scene, which all entries share: only what is in front of it differs
        return one_by_one(op)(size, inputs, is_batched)
    rows = _folded(k + 1, size, [*inputs[:k], None, *inputs[k + 1 :]], is_batched)
    found = call(op, *rows[:k], inputs[k][0], *rows[k + 1 :])
    return tuple(x.reshape(size, x.shape[0] // size, *x.shape[1:]) for x in found)


def _along(tangents, scene):
    return [torch.zeros_like(x) if t is None or t.shape != x.shape else t for t, x in zip(tangents, scene)]


def _jvp(inputs, tangents, outputs):
    return (*call(TANGENT, *_along(tangents[:8], inputs), outputs[6], *inputs[:19], *inputs[20:]), *[None] * 4)


def _second(scene, tangents, images, options, active):
    if scene[0].device.type != "cpu":
        _refuse(2, "second derivative on a GPU; use tensors on the CPU")
    return call(SECOND, *scene, *_along(tangents, scene), *images, *options, *active)


def _second_setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:4], *inputs[7:18], *inputs[27:])
    ctx.options = inputs[18:23]


def _second_backward(ctx, *grads):
    saved = ctx.saved_tensors
    tangents = _second(saved[4:15], grads, saved[:4], ctx.options, saved[15:])
    return (*tangents[:4], None, None, None, *tangents[4:], *[None] * 13)


def _second_jvp(inputs, tangents, outputs):
    linear = call(f"{OP}_backward", *_along(tangents[:4], inputs), *inputs[4:])
    others = _second(inputs[7:18], tangents[7:15], inputs[:4], inputs[18:23], inputs[27:])[4:]
    return tuple(a + b if a.shape == b.shape else a for a, b in zip(linear, others, strict=True))


def _refuse(order, said, *_):
    raise GradientError(f"{OP} (order {order}): the rasterizer has no {said}", op=OP, argument=None, order=order)


register_gradients(OP, _backward, _setup, without=["Ks"], jvp=_jvp, batched=_batched)
rule = partial(_kept_batched, f"{OP}_backward", 6)
register_gradients(f"{OP}_backward", _second_backward, _second_setup, jvp=_second_jvp, batched=rule)
rule, none = partial(_refuse, 2, "derivative of forward mode; use torch.func.hessian, on the CPU"), lambda *_: None
register_gradients(TANGENT, rule, none, jvp=rule, batched=partial(_kept_batched, TANGENT, 8))
rule = partial(_refuse, 3, "third derivative, and none of forward mode; detach the second, or use torch.func.hessian")
register_gradients(SECOND, rule, none, jvp=rule, batched=one_by_one(SECOND))
register_autocast(OP, "float32")
