"""Plane-sweep cost volume: how well each pixel matches other views at each candidate depth."""

import torch
from torch import Tensor

from gsim3d.errors import NumericalError
from gsim3d.ops._arguments import check_floating, check_numbers, check_splits, check_tensors
from gsim3d.ops._register import call, fakes, register_autocast, register_gradients, save_inputs


def sweep_geometry(
    Ks: Tensor, viewmats: Tensor, src_images: Tensor, cu_src: Tensor, *, Ks_target: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """How pixels of each image move into its source images, for :func:`plane_sweep`.

    Pair p of image i and source j maps array index (u, v) at depth d to ``q = A [u, v, 1] d + b`` with
    ``A = S^-1 K_j R K_i^-1 S``, ``b = S^-1 K_j t``, where ``x_j = R x_i + t`` between the cameras and S moves by half a
    pixel, since index 0 is the pixel centre 0.5. Computed in float64.

    Args:
        Ks: [I, 3, 3] intrinsics in pixels of the feature maps, pixel centres at +0.5.
        viewmats: [I, 4, 4] world-to-camera, OpenCV axes, metres.
        src_images: int64 [P], sources of image 0, then of image 1, ...
        cu_src: int64 [I + 1], offsets into ``src_images``.
        Ks_target: [P, 3, 3], intrinsics that project into the source of each pair; default: those of the source.
    Returns:
        homographies [P, 3, 3] and translations [P, 3] (metres), dtype of ``Ks``.
    Gradients:
        of ``Ks``, ``viewmats`` and ``Ks_target``; :func:`plane_sweep` has none of its geometry, and refuses it.
    Raises:
        NumericalError: a matrix is not finite or cannot be inverted; CPU only.
        ValueError, TypeError: an argument has a wrong shape, dtype or range; the message names it.

    Example:
        >>> A, b = sweep_geometry(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4),
        ...                       torch.tensor([1, 0]), torch.tensor([0, 1, 2]))
        >>> A.shape, b.shape
        (torch.Size([2, 3, 3]), torch.Size([2, 3]))
    """
    if not torch.compiler.is_compiling():
        _check_geometry(Ks, viewmats, src_images, cu_src, Ks_target)
    # Lists that are not checked, on a GPU, must not index beyond the ends.
    places = torch.arange(src_images.shape[0], device=Ks.device)
    own = torch.searchsorted(cu_src[1:], places, right=True).clamp(max=Ks.shape[0] - 1)
    src_images = src_images.clamp(0, Ks.shape[0] - 1)
    intrinsics, poses = Ks.double(), viewmats.double()
    target = intrinsics[src_images] if Ks_target is None else Ks_target.double()
    half_pixel = torch.eye(3, dtype=torch.float64, device=Ks.device)
    half_pixel[:2, 2] = 0.5
    relative = poses[src_images] @ _inverse("viewmats", poses)[own]
    to_index = torch.linalg.inv(half_pixel) @ target
    homographies = to_index @ relative[:, :3, :3] @ (_inverse("Ks", intrinsics) @ half_pixel)[own]
    translations = (to_index @ relative[:, :3, 3:])[..., 0]
    homographies, translations = homographies.to(Ks.dtype), translations.to(Ks.dtype)
    check_numbers("sweep_geometry: of Ks and viewmats", homographies=homographies, translations=translations)
    return homographies, translations


def _inverse(name: str, matrices: Tensor) -> Tensor:
    try:
        return torch.linalg.inv(matrices)
    except torch.linalg.LinAlgError:
        image = int((torch.linalg.inv_ex(matrices).info != 0).nonzero()[0])
        raise NumericalError(f"sweep_geometry: {name} cannot be inverted for image {image}", camera=image) from None


def _check_geometry(Ks: Tensor, viewmats: Tensor, src_images: Tensor, cu_src: Tensor, Ks_target: Tensor | None) -> None:
    op, matrices = "sweep_geometry", {"Ks": Ks, "viewmats": viewmats}
    matrices |= {} if Ks_target is None else {"Ks_target": Ks_target}
    check_tensors(op, **matrices, src_images=src_images, cu_src=cu_src)
    n, n_pairs = (x.shape[0] if x.dim() else 0 for x in (Ks, src_images))
    for name, shape in {"Ks": (n, 3, 3), "viewmats": (n, 4, 4), "Ks_target": (n_pairs, 3, 3)}.items():
        value = matrices.get(name)
        if value is not None and (value.shape != shape or value.dtype not in (torch.float32, torch.float64)):
            got = f"{value.dtype} {list(value.shape)}"
            raise ValueError(f"{op}: {name} must be float32 or float64 {list(shape)}; got {got}")
    for name, value, shape in (("src_images", src_images, (n_pairs,)), ("cu_src", cu_src, (n + 1,))):
        if value.dtype != torch.int64 or value.shape != shape:
            raise ValueError(f"{op}: {name} must be int64 {list(shape)}; got {value.dtype} {list(value.shape)}")
    if Ks.device.type != "cpu":
        return
    check_numbers(op, **matrices)
    if n_pairs and not (int(src_images.min()) >= 0 and int(src_images.max()) < n):
        raise ValueError(f"{op}: src_images must be in [0, {n})")
    check_splits(op, n_pairs, cu_src=cu_src)


def plane_sweep(
    features: Tensor,
    homographies: Tensor,
    translations: Tensor,
    inverse_depths: Tensor,
    src_images: Tensor,
    cu_src: Tensor,
    *,
    check: bool = True,
) -> Tensor:
    """Mean correlation of each pixel's feature with its sources' features at each candidate depth.

    ``cost[i, k, v, u] = mean over sources j of <f_i(u, v), f_j(x, y)> / sqrt(C)`` with
    ``q = A [u, v, 1] / inverse_depths[i, k] + b`` and ``(x, y) = (q_x, q_y) / max(q_z, 1e-3)`` in array indices;
    f_j is interpolated bilinearly and is zero outside. No warped volume is formed.

    Args:
        features: [I, C, h, w], float32 or float64.
        homographies, translations: [P, 3, 3] and [P, 3] from :func:`sweep_geometry`; dtype of ``features``.
        inverse_depths: [I, D], 1 / metres, positive.
        src_images: int64 [P], sources of image 0, then of image 1, ...
        cu_src: int64 [I + 1], offsets into ``src_images``; an image without sources costs 0.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [I, D, h, w], dtype of ``features``.
    Gradients:
        ``features``, once.
    Determinism:
        every output and gradient element has one owner that sums in a fixed order.
    Raises:
        NumericalError: a feature is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument has a wrong shape, dtype or range, or geometry is not finite; the message
            names it. On CUDA values are not looked at: a source out of range sees nothing.
    Source:
        plane sweep of Collins (1996) as in MVSplat (Chen et al. 2024), with dot products interpolated.

    Example:
        >>> A, b = sweep_geometry(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4),
        ...                       torch.tensor([1, 0]), torch.tensor([0, 1, 2]))
        >>> features, inverse_depths = torch.ones(2, 4, 1, 1), torch.ones(2, 1)
        >>> plane_sweep(features, A, b, inverse_depths, torch.tensor([1, 0]), torch.tensor([0, 1, 2]))[0]
        tensor([[[2.]]])
    """
    if check:
        geometry = {"homographies": homographies, "translations": translations, "inverse_depths": inverse_depths}
        check_tensors("plane_sweep", features=features, **geometry, src_images=src_images, cu_src=cu_src)
        check_floating("plane_sweep", features=features)
        check_numbers("plane_sweep", features=features)
    return call("plane_sweep", features, homographies, translations, inverse_depths, src_images, cu_src)


def _costs(features, homographies, translations, inverse_depths, src_images, cu_src):
    return features.new_empty(features.shape[0], inverse_depths.shape[1], *features.shape[2:])


fakes(plane_sweep=_costs, plane_sweep_backward=lambda grad, features, *_: features.new_empty(features.shape))


def _backward(ctx, grad):
    return call("plane_sweep_backward", grad, *ctx.saved_tensors), None, None, None, None, None


_without = ["homographies", "translations", "inverse_depths"]
register_gradients("plane_sweep", _backward, save_inputs, gradient_ops=["plane_sweep_backward"], without=_without)
register_autocast("plane_sweep", "float32")
