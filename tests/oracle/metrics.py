"""Image metrics from their definitions, pixel by pixel, in float64 numpy."""

import numpy as np


def psnr_reference(pred, target, mask=None):
    pred, target = np.clip(pred.astype(np.float64), 0, 1), np.clip(target.astype(np.float64), 0, 1)
    mask = np.ones(pred.shape[:2], bool) if mask is None else mask
    by_channel = [np.sum(mask * (pred[..., c] - target[..., c]) ** 2) / np.sum(mask) for c in range(pred.shape[2])]
    return -10 * np.log10(np.mean(by_channel))


def ssim_reference(x, y, sigma=1.5, radius=5):
    """Every window is visited on its own: weighted means, then weighted (co)variances around them."""
    offsets = np.arange(-radius, radius + 1)
    line = np.exp(-(offsets**2) / (2 * sigma**2))
    window = np.outer(line, line) / line.sum() ** 2
    n = window.size
    values = []
    for c in range(x.shape[2]):
        for i in range(radius, x.shape[0] - radius):
            for j in range(radius, x.shape[1] - radius):
                a = x[i - radius : i + radius + 1, j - radius : j + radius + 1, c]
                b = y[i - radius : i + radius + 1, j - radius : j + radius + 1, c]
                mean_a, mean_b = (window * a).sum(), (window * b).sum()
                var_a = (window * (a - mean_a) ** 2).sum() * n / (n - 1)
                var_b = (window * (b - mean_b) ** 2).sum() * n / (n - 1)
                cov = (window * (a - mean_a) * (b - mean_b)).sum() * n / (n - 1)
                values.append(
                    (2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)
                    / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
                )  # fmt: skip
    return float(np.mean(values))
