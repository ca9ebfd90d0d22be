"""Projection of 3D Gaussians through lenses in plain torch: Jacobians by automatic differentiation of the lens.

Written from OpenCV's camera models and the formulas of EWA splatting; it imports nothing from gsim3d.
"""

import torch

from tests.oracle.raster import FIELD_MARGIN, rotation_matrix

MIN_ALPHA, MAX_EXTENT = 1 / 255, 3.33


def lens_pixel(point, K, distortion, lens):
    """Pixel [2] of one point [3] of the camera's frame."""
    x, y, z = point
    k = distortion
    if lens == "fisheye":
        r = torch.sqrt(x * x + y * y)
        theta = torch.atan2(r, z)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        x, y = x * bent / r, y * bent / r
    elif lens != "orthographic":
        x, y = x / z, y / z
        if lens == "opencv":
            r2 = x * x + y * y
            radial = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
            x, y = (
                x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
                y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
            )
    return torch.stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]])


def near_image(point, K, width, height):
    """The point moved sideways, at its depth, to where its pixel is at most a margin outside of the image."""
    pixel = lens_pixel(point, K, None, "pinhole")
    size = torch.tensor([width, height], dtype=point.dtype)
    u, v = torch.minimum(torch.maximum(pixel, -FIELD_MARGIN * size), (1 + FIELD_MARGIN) * size)
    y = (v - K[1, 2]) / K[1, 1]
    # As in raster.py: both columns that divide by z see the clamped pixel.
    return torch.stack([((u - K[0, 2]) - K[0, 1] * y) / K[0, 0], y, torch.ones_like(y)]) * point[2]


def project(means, shapes, viewmat, K, width, height, *, lens, distortion, dilation, clamped):
    """means2d [N, 2], conics [N, 3], depths [N], compensations [N], covariance [N, 2, 2]; shapes: covariances."""
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    points = means @ W.T + t
    at = points
    if clamped and lens == "pinhole":
        at = torch.stack([near_image(p, K, width, height) for p in points])
    J = torch.func.vmap(torch.func.jacfwd(lambda p: lens_pixel(p, K, distortion, lens)))(at)
    means2d = torch.func.vmap(lambda p: lens_pixel(p, K, distortion, lens))(points)
    plain = J @ W @ shapes @ W.T @ J.mT
    covariance = plain + dilation * torch.eye(2, dtype=means.dtype)
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    compensations = torch.sqrt(torch.linalg.det(plain) / torch.linalg.det(covariance))
    return means2d, conics, points[:, 2], compensations, covariance


def covariances(quats, scales):
    axes = rotation_matrix(quats) @ torch.diag_embed(scales)
    return axes @ axes.mT


def radii(means2d, covariance, depths, width, height, *, near, far, clip, alphas=None):
    """int32 [N, 2]."""
    extent = torch.full_like(depths, MAX_EXTENT)
    seen = (depths > near) & (depths < far)
    if alphas is not None:
        extent = torch.minimum(extent, torch.sqrt(2 * torch.log((alphas / MIN_ALPHA).clamp_min(1))))
        seen &= alphas >= MIN_ALPHA
    reach = torch.ceil(extent[:, None] * covariance.diagonal(dim1=-2, dim2=-1).sqrt())
    size = torch.tensor([width, height], dtype=reach.dtype)
    seen &= ((means2d + reach > 0) & (means2d - reach < size)).all(1) & (reach > clip).any(1)
    return torch.where(seen[:, None], reach, 0).int()
