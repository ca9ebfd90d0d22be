"""A dense renderer of 3D Gaussians: every Gaussian at every pixel, sorted by depth, differentiated by autograd.

Written from the formulas of EWA splatting and 3D Gaussian splatting, without tiles, bounds or bookkeeping. It imports
nothing from gsim3d.
"""

import math

import torch

MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, DILATION, FIELD_MARGIN, TILE = 1 / 255, 0.99, 1e-4, 0.3, 0.15, 16


def legendre_basis(direction, degree):
    """Real spherical harmonics [N, (degree + 1)^2] in the 3DGS signs, from associated Legendre polynomials."""
    x, y, z = direction.unbind(-1)
    rim = torch.sqrt(x * x + y * y)
    angle = torch.atan2(y, x)
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            k = abs(m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - k) / math.factorial(l + k))
            value = norm * _legendre(l, k, z, rim)
            if m > 0:
                value = math.sqrt(2) * value * torch.cos(k * angle)
            elif m < 0:
                value = math.sqrt(2) * value * torch.sin(k * angle)
            columns.append(value)
    return torch.stack(columns, -1)


def _legendre(l, m, z, rim):
    """P_l^m with the Condon-Shortley sign, rim = sqrt(1 - z^2)."""
    value = math.prod(range(1, 2 * m, 2)) * (-rim) ** m
    before = torch.zeros_like(z)
    for degree in range(m, l):
        value, before = ((2 * degree + 1) * z * value - (degree + m) * before) / (degree - m + 1), value
    return value


def rotation_matrix(quats):
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def project(means, quats, scales, viewmat, K, width, height, jacobian="exact"):
    """Mean [N, 2] and dilated covariance [N, 2, 2] in pixels, camera point [N, 3]."""
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    point = means @ W.T + t
    pixels = point @ K.T
    mean2d = pixels[:, :2] / pixels[:, 2:]
    seen, z = mean2d, point[:, 2]
    if jacobian == "clamped":  # taken where pixel coordinates are at most a margin outside of the image
        size = torch.tensor([width, height], dtype=means.dtype)
        seen = mean2d.clamp(-FIELD_MARGIN * size, (1 + FIELD_MARGIN) * size)
    J = torch.zeros(len(means), 2, 3, dtype=means.dtype)
    J[:, 0, 0], J[:, 0, 1], J[:, 1, 1] = K[0, 0] / z, K[0, 1] / z, K[1, 1] / z
    J[:, :, 2] = -(seen - K[:2, 2]) / z[:, None]
    axes = J @ W @ rotation_matrix(quats) @ torch.diag_embed(scales)
    return mean2d, axes @ axes.mT + DILATION * torch.eye(2, dtype=means.dtype), point


def render_image(
    gaussians, background, viewmat, K, width, height, *, near_plane=0.01, cutoff="exact", jacobian="exact"
):
    """One image of (means, quats, scales, opacities, color, features); color [N, K, 3] or [N, 3]."""
    with torch.no_grad():
        means = gaussians[0]
        z = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
        order = torch.argsort(z, stable=True)
        order = order[z[order] > near_plane]
    means, quats, scales, opacities, color, features = (x[order] for x in gaussians)
    mean2d, covariance, point = project(means, quats, scales, viewmat, K, width, height, jacobian)
    if color.dim() == 3:
        direction = torch.nn.functional.normalize(point @ viewmat[:3, :3], dim=-1)
        degree = math.isqrt(color.shape[1]) - 1
        color = (torch.einsum("nk,nkc->nc", legendre_basis(direction, degree), color) + 0.5).clamp_min(0)
    values = torch.cat([color, point[:, 2:], features], -1)  # [N, 4 + F]

    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], -1).to(means.dtype) + 0.5
    offset = pixels[None] - mean2d[:, None, None]  # [N, H, W, 2]
    power = -0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, torch.linalg.inv(covariance), offset)
    alpha = (opacities[:, None, None] * torch.exp(power)).clamp_max(MAX_ALPHA)
    if cutoff == "smooth":
        t = (alpha / MIN_ALPHA - 1).clamp(0, 1)
        alpha = alpha * (3 * t**2 - 2 * t**3)
    else:
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0)
    if cutoff == "tile3sigma":
        alpha = torch.where(tiles_touched(mean2d, covariance, x, y), alpha, 0)

    light = torch.ones(height, width, dtype=means.dtype)
    going = torch.ones(height, width, dtype=torch.bool)
    total = torch.zeros(height, width, values.shape[1], dtype=means.dtype)
    for n in range(len(means)):
        rest = light * (1 - alpha[n])
        going = going & (rest >= MIN_TRANSMITTANCE)
        weight = torch.where(going, light * alpha[n], 0)
        total = total + weight[..., None] * values[n]
        light = torch.where(going, rest, light)
    return total[..., :3] + light[..., None] * background, 1 - light, total[..., 3], total[..., 4:]


def tiles_touched(mean2d, covariance, x, y):
    """bool [N, H, W]: pixels of the tiles that a square of 3 standard deviations about the mean touches."""
    middle = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    largest = middle + (middle**2 - torch.linalg.det(covariance)).clamp_min(0.1).sqrt()
    radius = (3 * largest.sqrt()).ceil()
    inside = torch.ones(len(mean2d), *x.shape, dtype=torch.bool)
    for axis, pixel in enumerate((x, y)):
        centre = mean2d[:, axis] - 0.5
        low = ((centre - radius) / TILE).trunc().clamp_min(0)[:, None, None]
        high = ((centre + radius + TILE - 1) / TILE).trunc()[:, None, None]
        tile = pixel // TILE
        inside &= (tile >= low) & (tile < high)
    return inside


def render(
    means, quats, scales, opacities, color, features, background, viewmats, Ks, image_cloud, cu_rows, size, **options
):
    """All images of a call, given as packed rows: color [I, H, W, 3], alpha, depth [I, H, W], features [I, H, W, F]."""
    images = []
    for i, cloud in enumerate(image_cloud.tolist()):
        rows = slice(int(cu_rows[cloud]), int(cu_rows[cloud + 1]))
        gaussians = [x[rows] for x in (means, quats, scales, opacities, color, features)]
        images.append(render_image(gaussians, background[i], viewmats[i], Ks[i], *size, **options))
    return tuple(torch.stack(parts) for parts in zip(*images))
