"""Projection and colours of 3D Gaussians on their own, for programs that blend or densify by what it says."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.errors import check_one_of
from gsim3d.ops._arguments import (
    check_floating,
    check_numbers,
    check_real,
    check_splits,
    check_tensors,
    constant,
    offsets,
    within_memory,
)
from gsim3d.ops._register import call, fakes, register_autocast, register_gradients, save_inputs
from gsim3d.ops.raster import LARGEST, check_scene

OP = "project_gaussians"
LENSES = {"pinhole": 0, "orthographic": 1, "opencv": 2, "fisheye": 3}
JACOBIANS = ("exact", "clamped")
N_DISTORTION = {"opencv": (4, 5, 8), "fisheye": (4,)}  # numbers of coefficients that a lens may have


class Projection(NamedTuple):
    """Gaussians in the images of one call: P pairs of an image and a row of the cloud that it shows.

    A pair that is not seen holds zeros.

    Attributes:
        means2d: [P, 2] pixels.
        conics: [P, 3] px^-2, entries (xx, xy, yy) of the inverse covariance.
        depths: [P] metres, camera z.
        radii: int32 [P, 2] pixels, half the width and height within which it shows; 0 where it is not seen.
        compensations: [P], by which an opacity is multiplied so that the dilation adds no light.
        cu_pairs: int64 [I + 1], pairs of image i are cu_pairs[i] .. cu_pairs[i + 1], in the order of rows.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor
    compensations: Tensor
    cu_pairs: Tensor


def project_gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    cameras: Cameras,
    *,
    covars: Tensor | None = None,
    opacities: Tensor | None = None,
    lens: str = "pinhole",
    distortion: Tensor | None = None,
    cu_rows: Tensor | None = None,
    n_clouds: int | None = None,
    n_pairs: int | None = None,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    dilation: float = 0.3,
    jacobian: str = "exact",
    antialiased: bool = False,
    check: bool = True,
) -> Projection:
    """Projects clouds of 3D Gaussians into images, for :func:`rasterize_projected`.

    A Gaussian's mean goes through the lens; its covariance through the lens's exact derivative J there, as
    ``J W R S S R^T W^T J^T + dilation I``. A pair of a Gaussian and an image is not seen where the mean is outside of
    (near_plane, far_plane) or beyond the radius at which the lens folds back, where its opacity is below 1/255, both
    radii are at most ``radius_clip`` or its bounds are outside of the image.

    Args:
        means: [N, 3] metres; float32 or float64, the dtype of all others.
        quats: [N, 4] (w, x, y, z), normalised inside; None with ``covars``.
        scales: [N, 3] metres, standard deviations, not negative; None with ``covars``.
        cameras: I images, cast to the dtype of ``means``, like ``distortion``; ``near`` and ``far`` are not read.
        covars: [N, 3, 3] m^2, symmetric, in place of ``quats`` and ``scales``; the upper half is read.
        opacities: [N] in [0, 1]; with them radii end where alpha falls below 1/255. They get no gradient.
        lens: "pinhole"; "orthographic": pixels are focal lengths times metres; "opencv": OpenCV's polynomial model;
            "fisheye": OpenCV's equidistant one.
        distortion: [I, 4, 5 or 8] k1, k2, p1, p2, k3, k4, k5, k6 of "opencv", [I, 4] k1 to k4 of "fisheye"; None: 0.
        cu_rows: int64 [Q + 1], rows of cloud q are cu_rows[q] .. cu_rows[q + 1]; default one cloud.
        n_clouds: rows, and images, are those of so many clouds of one size, in order, in place of ``cu_rows`` and
            ``cameras.image_cloud``.
        n_pairs: P; counted where it is not given, so on a GPU it is needed beside ``cu_rows``.
        near_plane, far_plane: metres of camera z.
        radius_clip: pixels.
        dilation: px^2, added to both variances.
        jacobian: as of :func:`rasterize_gaussians`, for pinholes.
        antialiased: the opacities will be multiplied by the compensation (Mip-Splatting): it counts for the radii.
        check: look at the arguments before the kernel does; a caller that has done so leaves it out.
    Returns:
        Projection, dtype of ``means``.
    Gradients:
        means, quats, scales or covars (symmetric), ``cameras.viewmats`` (its 12 upper entries taken as free numbers),
        ``cameras.Ks`` (focal lengths, skew, principal point) and distortion; once.
    Determinism:
        equal bits for any number of threads; on a GPU from run to run, and nothing waits for the device.
    Raises:
        NumericalError: a number is not finite or beyond 1e15, a scale negative or an opacity outside [0, 1]; CPU only.
            On a GPU such a row is not drawn.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source:
        Zwicker et al. 2002 (EWA splatting), Yu et al. 2024 (Mip-Splatting), OpenCV's camera models; conventions of
        gsplat.

    Example:
        >>> from gsim3d.cameras import Cameras
        >>> K = torch.tensor([[[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]]])
        >>> one, first = torch.ones(1), torch.zeros(1, dtype=torch.int64)
        >>> cameras = Cameras(torch.eye(4)[None], K, 0.1 * one, 10 * one, first, width=8, height=8)
        >>> covars = 0.04 * torch.eye(3)[None]
        >>> seen = project_gaussians(torch.tensor([[0.5, 0.0, 2.0]]), None, None, cameras, covars=covars)
        >>> seen.means2d, seen.radii
        (tensor([[6., 4.]]), tensor([[4, 4]], dtype=torch.int32))
    """
    if check:
        given = {"quats": quats, "scales": scales, "covars": covars, "opacities": opacities, "distortion": distortion}
        tensors = {"means": means} | {name: value for name, value in given.items() if value is not None}
        sizes = {name: size for name, size in (("n_clouds", n_clouds), ("n_pairs", n_pairs)) if size is not None}
        _check(tensors, cameras, cu_rows, sizes, lens, jacobian)
    check_real(OP, near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, dilation=dilation)
    real = torch.promote_types(means.dtype, torch.float32)
    n, n_images, device, image_cloud = means.shape[0], len(cameras), means.device, cameras.image_cloud
    if n_clouds is not None:
        each = n // max(1, n_clouds)
        image_cloud, cu_rows, cu_pairs = constant(_lists, n_clouds, n_images // max(1, n_clouds), each, device=device)
        n_pairs = n_images * each
    else:
        if cu_rows is None:
            cu_rows = constant(offsets, 1, n, device=device)
            n_pairs = n * n_images if n_pairs is None else n_pairs
        counts = F.pad(cu_rows[1:] - cu_rows[:-1], (0, 1))  # a cloud that is none has no rows
        cu_pairs = F.pad(counts[image_cloud.clamp(0, len(counts) - 1)].cumsum(0), (1, 0))
    if n_pairs is None:
        if device.type != "cpu":
            raise ValueError(f"{OP}: n_pairs is needed beside cu_rows on a GPU, where counting would wait for it")
        n_pairs = int(cu_pairs[-1])
    limits = None
    if distortion is not None:
        limits = lens_limits(lens, distortion).to(real)
        distortion = F.pad(distortion.to(real), (0, 8 - distortion.shape[1]))
    args = (
        *(means, quats, scales, covars, None if opacities is None else opacities.detach()),
        *(cameras.viewmats.to(real), cameras.Ks.to(real), distortion, limits),
        *(image_cloud, cu_rows, cu_pairs, n_pairs, cameras.width, cameras.height),
        *(near_plane, far_plane, radius_clip, dilation, LENSES[lens], jacobian == "clamped", antialiased),
    )
    return Projection._make((*within_memory(OP, f"n_pairs={n_pairs}", call, OP, *args), cu_pairs))


def _lists(n_clouds: int, n_images: int, n: int, *, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """image_cloud, cu_rows and cu_pairs of clouds of ``n`` rows, each shown by ``n_images``."""
    total = n_clouds * n_images
    owners = torch.arange(n_clouds, device=device).repeat_interleave(n_images, output_size=total)
    return owners, offsets(n_clouds, n, device=device), offsets(total, n, device=device)


def lens_limits(lens: str, distortion: Tensor) -> Tensor:
    """The largest radius up to which a lens does not fold back, found on 512 steps and on finer ones in between.

    Args:
        lens: "opencv" or "fisheye".
        distortion: [I, D], as of :func:`project_gaussians`; tangential terms do not count.
    Returns:
        float64 [I]: tangent ("opencv") or angle in radians ("fisheye"); infinite where it never does.
    """
    k = F.pad(distortion.detach().double(), (0, 8 - distortion.shape[1]))
    fisheye = lens == "fisheye"
    up, down = (k[:, :4], k[:, 4:]) if fisheye else (torch.cat([k[:, :2], k[:, 4:5]], 1), k[:, 5:])
    n, radius = torch.arange(1, up.shape[1] + 1, device=k.device), torch.positive if fisheye else torch.tan

    def folds(r: Tensor) -> Tensor:
        """bool [I, S] at radii [I, S]."""
        powers = (r * r)[..., None] ** n
        above, below = (1 + (c[:, None] * powers).sum(-1) for c in (up, down))
        slope = 1 + ((2 * n + 1) * up[:, None] * powers).sum(-1)  # of r * above
        descent = (2 * n * down[:, None] * powers).sum(-1)  # r times that of below
        return torch.le(below, 0) | torch.le(slope * below - above * descent, 0)

    low, high = torch.zeros_like(k[:, :1]), torch.full_like(k[:, :1], math.pi if fisheye else math.pi / 2 - 1e-2)
    for n_steps in (512, *[64] * 5):  # a GPU launches each operation
        grid = low + (high - low) * torch.arange(n_steps + 1, device=k.device) / n_steps
        first = folds(radius(grid)).int().argmax(1, keepdim=True)  # 0: never
        low, high = grid.gather(1, (first - 1).clamp_min(0)), grid.gather(1, first)
    return torch.where(high > 0, radius(low), math.inf)[:, 0]


def sh_to_color(directions: Tensor, sh: Tensor) -> Tensor:
    """Colours of real spherical harmonics seen along directions, ``max(0, 0.5 + sum_k basis_k sh_k)``.

    Args:
        directions: [N, 3], [V, N, 3] or [B, V, N, 3] of any length, from the camera to the Gaussian; float32 or
            float64.
        sh: [N, K, D], or [B, N, K, D] beside B; K = 1, 4, 9, 16 or 25 coefficients (degree 0 to 4) in the standard 3DGS
            basis and order, D channels. float16 and bfloat16 are computed in the dtype of ``directions``.
    Returns:
        [..., N, D], leading sizes and dtype of ``directions``: views of one row share its coefficients, which are not
        copied.
    Gradients:
        directions and sh, once; none where a colour was clamped at 0, and none to directions shorter than 1e-18.
    Determinism:
        equal bits for any number of threads.
    Raises:
        NumericalError: a number is not finite or beyond 1e15; CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source:
        Sloan 2013, Efficient spherical harmonic evaluation; signs and order of 3DGS.

    Example:
        >>> sh_to_color(torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1, 1, 3)).round(decimals=3)
        tensor([[0.7820, 0.7820, 0.7820]])
    """
    check_tensors("sh_to_color", directions=directions, sh=sh)
    check_floating("sh_to_color", {"sh": sh}, directions=directions)
    if not 2 <= directions.dim() <= 4 or sh.dim() != (4 if directions.dim() == 4 else 3):
        wanted = "[N, 3] or [V, N, 3] with sh [N, K, D], or [B, V, N, 3] with sh [B, N, K, D]"
        raise ValueError(f"sh_to_color: directions must be {wanted}; got {list(directions.shape)} and {list(sh.shape)}")
    check_numbers("sh_to_color", largest_of=LARGEST, directions=directions, sh=sh)
    seen = directions[(None,) * (4 - directions.dim())]
    of_rows = sh[(None,) * (4 - sh.dim())].to(directions.dtype)
    return call("sh_to_color", seen, of_rows).reshape(*directions.shape[:-1], sh.shape[-1])


def _check(tensors: dict, cameras: Cameras, cu_rows: Tensor | None, sizes: dict, lens: str, jacobian: str) -> None:
    check_scene(OP, tensors | ({} if cu_rows is None else {"cu_rows": cu_rows}), cameras, **sizes)
    if ("covars" in tensors) == ("quats" in tensors or "scales" in tensors):
        raise ValueError(f"{OP}: give quats and scales, or covars")
    check_one_of(f"{OP}: lens", lens, LENSES)
    check_one_of(f"{OP}: jacobian", jacobian, JACOBIANS)
    n, n_clouds = len(tensors["means"]), sizes.get("n_clouds", 1)
    split = all(size == (0 if n_clouds == 0 else size // n_clouds * n_clouds) for size in (n, len(cameras)))
    if n_clouds < 0 or not split or (cu_rows is not None and "n_clouds" in sizes):
        wanted = f"divide N={n} rows and I={len(cameras)} images, and stand in place of cu_rows"
        raise ValueError(f"{OP}: n_clouds must {wanted}; got {n_clouds}")
    clouds = cameras.image_cloud
    if clouds.dtype != torch.int64 or clouds.dim() != 1:
        raise ValueError(f"{OP}: cameras.image_cloud must be int64 [I]; got {clouds.dtype} {list(clouds.shape)}")
    check_splits(OP, len(tensors["means"]), cu_rows=cu_rows)
    distortion, n_images = tensors.get("distortion"), len(cameras)
    if distortion is not None:
        sizes = N_DISTORTION.get(lens, ())
        if not sizes:
            raise ValueError(f"{OP}: distortion is of the lenses opencv and fisheye; got it with {lens}")
        if distortion.dim() != 2 or distortion.shape[0] != n_images or distortion.shape[1] not in sizes:
            wanted = " or ".join(str(size) for size in sizes)
            raise ValueError(f"{OP}: distortion must be [I={n_images}, {wanted}]; got {list(distortion.shape)}")
    check_numbers(OP, largest_of=LARGEST, **tensors)
    check_numbers(OP, negative=False, scales=tensors.get("scales"))
    check_numbers(OP, largest_of=1.0, negative=False, opacities=tensors.get("opacities"))


def _pairs(means, *rest):
    n_pairs = rest[11]
    means2d, conics, depths, compensations = (means.new_empty(n_pairs, *size) for size in ((2,), (3,), (), ()))
    return means2d, conics, depths, means.new_empty(n_pairs, 2, dtype=torch.int32), compensations


def _gradients(*inputs):  # of four outputs, then the radii
    means, quats, scales, covars, viewmats, _, distortion, *_, viewmats_grad, lens_grad = inputs[5:]
    n, n_images = means.shape[0], viewmats.shape[0]
    n_axes, n_lens = (0 if quats is None else n), (n_images if lens_grad else 0)
    shapes = [(n, 3), (n_axes, 4), (n_axes, 3), (0 if covars is None else n, 3, 3)]
    shapes += [(n_images if viewmats_grad else 0, 4, 4), (n_lens, 3, 3), (0 if distortion is None else n_lens, 8)]
    return tuple(means.new_empty(shape) for shape in shapes)


def _setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[3])
    means, quats, scales, covars, _, viewmats, Ks, distortion, _, *lists = inputs[:12]
    ctx.save_for_backward(output[3], means, quats, scales, covars, viewmats, Ks, distortion, *lists)
    n_pairs, width, height, _, _, _, dilation, lens, clamped, _ = inputs[12:]
    ctx.options = (n_pairs, width, height, dilation, lens, clamped)


def _backward(ctx, means2d, conics, depths, _, compensations):
    saved, (of_viewmats, of_Ks, of_distortion) = ctx.saved_tensors, ctx.needs_input_grad[5:8]
    options = *ctx.options, of_viewmats, of_Ks or of_distortion
    grads = call("project_gaussians_backward", means2d, conics, depths, compensations, *saved, *options)
    wanted = (True, *(x is not None for x in saved[2:5]), of_viewmats, of_Ks, of_distortion)
    grads = [grad if want else None for grad, want in zip(grads, wanted, strict=True)]
    return *grads[:4], None, *grads[4:], *[None] * 14  # none of opacities


def _sh_backward(ctx, grad):
    return call("sh_to_color_backward", grad, *ctx.saved_tensors)


fakes(
    project_gaussians=_pairs,
    project_gaussians_backward=_gradients,
    sh_to_color=lambda directions, sh: directions.new_empty(*directions.shape[:3], sh.shape[3]),
    sh_to_color_backward=lambda grad, *inputs: tuple(x.new_empty(x.shape) for x in inputs),
)
register_gradients(OP, _backward, _setup, gradient_ops=[f"{OP}_backward"], without=["opacities", "limits"])
register_gradients("sh_to_color", _sh_backward, save_inputs, gradient_ops=["sh_to_color_backward"])
for _op in (OP, "sh_to_color"):
    register_autocast(_op, "float32")
