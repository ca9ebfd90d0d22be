"""gsplat's call on this project's kernels: ``from gsim3d.compat.gsplat import rasterization``.

The signature, shapes and conventions of gsplat 1.6.0's ``rasterization`` for 3D Gaussian splatting, on CPU and CUDA,
with equal bits from run to run.
"""

import math
import weakref
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.errors import InputError, check_one_of
from gsim3d.ops._arguments import check_floating, check_numbers, check_real, check_tensors, check_whole, constant
from gsim3d.ops.projection import Projection, project_gaussians, sh_to_color
from gsim3d.ops.raster import LARGEST, Rendering, check_last_rows
from gsim3d.ops.raster_projected import rasterize_projected

OP = "rasterization"
LENSES = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
NO_TILES = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "tile_width", "tile_height")


class Meta(dict):
    """What :func:`rasterization` knows of every Gaussian in every image; lists of tiles are refused by name."""

    def get(self, key: str, default: Any = None) -> Any:
        return self[key] if key in self or key in NO_TILES else default

    def __missing__(self, key: str) -> Any:
        if key in NO_TILES:
            advice = "the kernel makes tiles in a form of its own; read radii, means2d, conics and depths"
            raise InputError(f"{OP}: meta[{key!r}] is not kept: {advice}")
        raise KeyError(key)


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
) -> tuple[Tensor, Tensor, Meta]:
    """Renders 3D Gaussians as gsplat does.

    Sizes: leading batch dimensions ``...``, C cameras, N Gaussians, D channels, K coefficients.

    Args:
        means: [..., N, 3] metres; float32 or float64, the dtype of all others.
        quats: [..., N, 4] (w, x, y, z), of any length.
        scales: [..., N, 3] metres, standard deviations.
        opacities: [..., N] in [0, 1].
        colors: [..., N, D] or [..., C, N, D]; with ``sh_degree`` [N, K, D] or [..., N, K, D] coefficients; also
            float16. None where ``render_mode`` has no colour.
        viewmats: [..., C, 4, 4] world to camera; like ``Ks`` and coefficients cast to the dtype of ``means``.
        Ks: [..., C, 3, 3] pixels.
        width, height: pixels.
        near_plane, far_plane: metres of camera z.
        radius_clip: pixels; Gaussians whose radii are both at most this are left out.
        eps2d: px^2, added to both variances.
        sh_degree: 0 to 4, of the coefficients that are used.
        packed: ``meta`` has a row for each Gaussian that is seen; on a GPU counting them waits for it.
        backgrounds: [..., C, D]; black where there are none.
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED".
        absgrad: after the backward pass ``meta["means2d"].absgrad`` is the sum over pixels of absolute gradients.
        rasterize_mode: "classic", or "antialiased": opacities are multiplied by Mip-Splatting's compensation.
        camera_model: "pinhole", "ortho" or "fisheye".
        covars: [..., N, 3, 3] m^2, in place of ``quats`` and ``scales``.
        radial_coeffs: [..., C, 6] k1 to k6 of OpenCV's pinhole, or [..., C, 4] k1 to k4 of its fisheye.
        tangential_coeffs: [..., C, 2] p1, p2 of OpenCV's pinhole.
        tile_size, channel_chunk, segmented: of gsplat's kernels; they change no result here.
        sparse_grad: not offered, like distributed, with_ut, with_eval3d, return_normals, global_z_order, rays,
            thin_prism_coeffs, ftheta_coeffs, lidar_coeffs, external_distortion_coeffs, rolling_shutter, viewmats_rs,
            ut_params, extra_signals, extra_signals_sh_degree and renderer_config; any but the default raises.
    Returns:
        Images [..., C, height, width, D (+ 1)], depth last; alpha [..., C, height, width, 1]; ``meta`` with "means2d"
        [..., C, N, 2], "radii" int32 [..., C, N, 2], "depths" and "opacities" [..., C, N], "conics" [..., C, N, 3], and
        None for "batch_ids", "camera_ids" and "gaussian_ids"; packed: [nnz, ...] and int64 ids. Also "width",
        "height", "tile_size", "n_batches" and "n_cameras".
    Gradients:
        means, quats, scales, covars, opacities, colors, viewmats, backgrounds; unlike there also Ks and the
        coefficients. ``meta["means2d"]`` carries the gradient of the images.
    Raises:
        InputError: an argument or a value that is not offered, or a list of tiles read from ``meta``.
        ValueError, TypeError: a shape or dtype is not as above.
    """
    offered = {
        "sparse_grad": sparse_grad, "distributed": distributed, "with_ut": with_ut, "with_eval3d": with_eval3d,
        "return_normals": return_normals, "global_z_order": not global_z_order, "rays": rays,
        "thin_prism_coeffs": thin_prism_coeffs, "ftheta_coeffs": ftheta_coeffs, "lidar_coeffs": lidar_coeffs,
        "external_distortion_coeffs": external_distortion_coeffs, "viewmats_rs": viewmats_rs, "ut_params": ut_params,
        "rolling_shutter": None if getattr(rolling_shutter, "name", "") == "GLOBAL" else rolling_shutter,
        "extra_signals": extra_signals, "extra_signals_sh_degree": extra_signals_sh_degree,
        "renderer_config": renderer_config, "absgrad under torch.compile": absgrad and torch.compiler.is_compiling(),
    }  # fmt: skip
    _refuse(offered, {"camera_model": (camera_model, LENSES), "render_mode": (render_mode, RENDER_MODES),
                      "rasterize_mode": (rasterize_mode, RASTERIZE_MODES)})  # fmt: skip
    with_color, with_depth = "RGB" in render_mode, "D" in render_mode.removeprefix("RGB")
    optional = {"quats": quats, "scales": scales} if covars is None else {"covars": covars}
    optional |= {"radial_coeffs": radial_coeffs, "tangential_coeffs": tangential_coeffs}
    optional |= {"colors": colors, "backgrounds": backgrounds} if with_color else {}
    check_whole(OP, width=width, height=height)
    if not (0 < width < 2**16 and 0 < height < 2**16):
        raise ValueError(f"{OP}: width and height must be in [1, 65535]; got {width} and {height}")
    check_real(OP, eps2d=eps2d)
    if not 0 <= eps2d < math.inf:
        raise ValueError(f"{OP}: eps2d must be finite and not negative; got {eps2d}")
    _check(camera_model, means, viewmats, Ks, opacities, optional)
    batch, n, n_cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    means, viewmats, Ks = (x.to(torch.promote_types(means.dtype, torch.float32)) for x in (means, viewmats, Ks))
    n_batches, n_images = math.prod(batch), math.prod((*batch, n_cameras))
    antialiased = rasterize_mode == "antialiased"
    lens, distortion = _lens(LENSES[camera_model], radial_coeffs, tangential_coeffs, n_images)
    unread = constant(torch.arange, n_images, device=means.device)  # planes and clouds
    cameras = Cameras(viewmats.flatten(0, -3), Ks.flatten(0, -3), unread, unread, unread, width, height)
    shapes = (None, None) if covars is not None else (quats.flatten(0, -2), scales.flatten(0, -2))
    limits = {"near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip, "dilation": eps2d}
    options = {"lens": lens, "distortion": distortion, "jacobian": "clamped", "antialiased": antialiased, **limits}
    flat_opacities, flat_covars = opacities.flatten(), None if covars is None else covars.flatten(0, -3)
    options |= {"covars": flat_covars, "opacities": flat_opacities, "n_clouds": n_batches, "check": False}
    try:
        projection = project_gaussians(means.flatten(0, -2), *shapes, cameras, **options)
    except (ValueError, TypeError) as error:  # of cameras, size and planes, which are looked at there
        error.args = (str(error).replace("project_gaussians", OP, 1),)
        raise
    values = _colors(colors, sh_degree, means, viewmats) if with_color else means.new_zeros(n_images * n, 0)
    alphas = flat_opacities if n_cameras == 1 else opacities[..., None, :].expand(*batch, n_cameras, n).reshape(-1)
    alphas = alphas * projection.compensations if antialiased else alphas
    rows, cu_pairs = (*projection[:4], alphas, values), projection.cu_pairs
    meta = Meta(batch_ids=None, camera_ids=None, gaussian_ids=None, tile_size=tile_size or 16)
    sizes = (*batch, n_cameras, n)
    if packed:
        rows, cu_pairs, ids = _seen(rows, projection, n, n_cameras)
        meta |= ids
        sizes = (rows[0].shape[0],)
    means2d, conics, depths, radii, alphas, values = rows
    known = {"radii": radii, "means2d": means2d, "depths": depths, "conics": conics, "opacities": alphas}
    meta |= {name: row.reshape(*sizes, *row.shape[1:]) for name, row in known.items()}
    meta |= {"width": width, "height": height, "n_batches": n_batches, "n_cameras": n_cameras}
    # The 2D means as they are in meta are what is blended, so that they get a gradient.
    means2d = meta["means2d"]
    backgrounds = backgrounds.flatten(0, -2) if with_color and backgrounds is not None else None
    absolute = _absolute(means2d) if absgrad and means2d.requires_grad else None
    image = rasterize_projected(
        *(means2d.flatten(0, -2), conics, depths, alphas, values),
        width=width, height=height, cu_pairs=cu_pairs, background=backgrounds, absolute=absolute,
        check=False,
    )  # fmt: skip
    return *_images(image, render_mode if with_depth else "RGB", (*batch, n_cameras)), meta


def _refuse(offered: dict[str, Any], choices: dict[str, tuple[str, Sequence[str]]]) -> None:
    for name, value in offered.items():
        if value is not None and value is not False:
            raise InputError(f"{OP}: {name} is not offered; leave it at its default")
    for name, (value, known) in choices.items():
        check_one_of(f"{OP}: {name}", value, known)


def _check(camera_model: str, means, viewmats, Ks, opacities, optional: dict[str, Tensor | None]) -> None:
    tensors = {"means": means, "viewmats": viewmats, "Ks": Ks, "opacities": opacities}
    given = {name: value for name, value in optional.items() if value is not None}
    check_tensors(OP, **tensors, **given)
    if means.dim() < 2 or viewmats.dim() < 3 or any(value.dim() == 0 for value in given.values()):
        raise ValueError(f"{OP}: means must be [..., N, 3], viewmats [..., C, 4, 4]: too few dimensions")
    batch, n, n_cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    shapes = {"means": (n, 3), "opacities": (n,), "viewmats": (n_cameras, 4, 4), "Ks": (n_cameras, 3, 3)}
    shapes |= {"covars": (n, 3, 3)} if "covars" in optional else {"quats": (n, 4), "scales": (n, 3)}
    n_radial = 4 if camera_model == "fisheye" or given.get("radial_coeffs", means).shape[-1] == 4 else 6
    channels = given.get("colors", means).shape[-1]
    of_cameras = {"backgrounds": channels, "radial_coeffs": n_radial, "tangential_coeffs": 2}
    shapes |= {name: (n_cameras, size) for name, size in of_cameras.items() if name in given}
    tensors |= optional
    for name, shape in shapes.items():
        value = tensors[name]
        if value is None or value.shape != (*batch, *shape):
            got = None if value is None else list(value.shape)
            raise ValueError(f"{OP}: {name} must be {[*batch, *shape]}; got {got}")
    check_floating(OP, {name: given.get(name) for name in ("colors", "backgrounds")}, means=means)
    check_numbers(OP, largest_of=LARGEST, means=means, **given)
    check_numbers(OP, negative=False, scales=given.get("scales"))
    check_numbers(OP, largest_of=1.0, negative=False, opacities=opacities)
    check_last_rows(OP, viewmats, Ks)


def _lens(lens: str, radial: Tensor | None, tangential: Tensor | None, n_images: int) -> tuple[str, Tensor | None]:
    """The lens, and its coefficients in OpenCV's order."""
    if radial is None and tangential is None:
        return lens, None
    if lens == "orthographic" or (lens == "fisheye" and tangential is not None):
        raise InputError(f"{OP}: radial_coeffs are of camera_model pinhole and fisheye, tangential_coeffs of pinhole")
    if lens == "fisheye":
        return lens, radial.reshape(n_images, 4)
    zeros = (radial if tangential is None else tangential).new_zeros(n_images, 6)
    k = zeros if radial is None else radial.reshape(n_images, radial.shape[-1])
    p = zeros[:, :2] if tangential is None else tangential.reshape(n_images, 2)
    return "opencv", torch.cat([k[:, :2], p, k[:, 2:], zeros[:, k.shape[1] :]], 1)


def _colors(colors: Tensor | None, sh_degree: int | None, means: Tensor, viewmats: Tensor) -> Tensor:
    """Colours of pairs, [I N, D]."""
    batch, n, n_cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    if colors is None:
        raise ValueError(f"{OP}: colors are needed, unless render_mode is D or ED")
    if sh_degree is None:
        of_images = colors.shape[:-1] == (*batch, n_cameras, n)
        if not of_images and colors.shape[:-1] != (*batch, n):
            wanted = f"{[*batch, n, 'D']} or {[*batch, n_cameras, n, 'D']}".replace("'", "")
            raise ValueError(f"{OP}: colors must be {wanted}; got {list(colors.shape)}")
        if not of_images and n_cameras != 1:
            colors = colors[..., None, :, :].expand(*batch, n_cameras, n, colors.shape[-1])
        return colors.flatten(0, -2)
    check_whole(OP, sh_degree=sh_degree)
    shared, n_terms = colors.dim() == 3, (sh_degree + 1) ** 2
    if colors.shape[:-2] not in ((n,), (*batch, n)) or not 0 <= sh_degree <= 4 or colors.shape[-2] < n_terms:
        wanted = f"with sh_degree={sh_degree} (0 to 4) colors must be [N={n}, K >= {n_terms}, D]"
        raise ValueError(f"{OP}: {wanted}; got {list(colors.shape)}")
    sh = colors[..., :n_terms, :]
    turned, moved = viewmats[..., :3, :3], viewmats[..., :3, 3]
    centre = -(turned * moved[..., None]).sum(-2)  # autocast would round a product of matrices
    directions = means[..., None, :, :] - centre[..., None, :]
    rows = (directions.flatten(0, -3), sh) if shared else (directions.flatten(0, -4), sh.flatten(0, -4))
    return sh_to_color(*rows).flatten(0, -2)


def _seen(rows: tuple[Tensor, ...], projection: Projection, n: int, n_cameras: int) -> tuple:
    """Rows of the pairs that are seen, where those of each image begin, and whose they are."""
    pairs = (projection.radii > 0).all(1).nonzero()[:, 0]
    images = pairs // n
    counts = torch.zeros(len(projection.cu_pairs), dtype=torch.int64, device=pairs.device)
    cu_pairs = counts.index_add_(0, images + 1, torch.ones_like(images)).cumsum(0)
    ids = {"batch_ids": images // n_cameras, "camera_ids": images % n_cameras, "gaussian_ids": pairs % n}
    return tuple(row[pairs] for row in rows), cu_pairs, ids


def _absolute(means2d: Tensor) -> Tensor:
    """Zeros whose gradient becomes ``means2d.absgrad``."""
    absolute = torch.zeros_like(means2d).reshape(-1, 2).requires_grad_()
    shape, to = means2d.shape, weakref.ref(means2d)

    def keep(grad: Tensor) -> None:
        tensor = to()
        if tensor is not None:
            tensor.absgrad = grad.reshape(shape)

    absolute.register_hook(keep)
    return absolute


def _images(image: Rendering, render_mode: str, sizes: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Colour with depth as the last channel, and alpha."""
    color, alpha = image.color, image.alpha[..., None]
    if render_mode != "RGB":
        depth = image.depth / image.alpha.clamp_min(1e-10) if render_mode.endswith("ED") else image.depth
        color = torch.cat([color, depth[..., None]], -1) if "RGB" in render_mode else depth[..., None]
    if len(sizes) == 1:
        return color, alpha
    return color.unflatten(0, sizes), alpha.unflatten(0, sizes)
