"""FVD (Frechet Video Distance) between two sets of clips.

``|mean_a - mean_b|^2 + tr(C_a + C_b - 2 (C_a C_b)^(1/2))``, the Frechet distance between Gaussians fitted to the 400
logits of I3D (Kinetics-400).

Source:
    Unterthiner et al. 2018, "Towards accurate generative models of video: a new metric and challenges".
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.colors import as_colors, check_colors
from gsim3d.evaluate.perceptual.i3d import I3D, INPUT_SIZE
from gsim3d.evaluate.perceptual.weights import load
from gsim3d.nn.layers import exact_convolutions

MIN_FRAMES = 10  # I3D halves time three times, then averages pairs
MIN_CLIPS = 2  # for a covariance
TREND_CLIPS = 256  # with fewer clips the fitted covariances are inaccurate


@torch.no_grad()
def clip_features(clips: Tensor) -> Tensor:
    """Computes I3D's logits of each clip, resized to 224 x 224 (bilinear, without keeping the aspect ratio).

    Args:
        clips: [K, T, H, W, 3], T at least 10, floating point in [0, 1], or uint8, which is divided by 255.

    Returns:
        float64 [K, 400].

    Raises:
        InputError: shapes are wrong, clips are not in [0, 1], or the weights are not installed (`gsim3d weights fvd`).
    """
    check_colors(clips, "fvd: clips")
    if clips.ndim != 5 or clips.shape[-1] != 3 or clips.shape[1] < MIN_FRAMES or 0 in clips.shape[2:]:
        raise InputError(f"fvd: clips must be [K, T, H, W, 3] with T >= {MIN_FRAMES}; got {tuple(clips.shape)}")
    module = load("fvd_i3d", I3D).to(clips.device)
    features = []
    for clip in clips:  # one at a time: a clip takes several hundred megabytes
        frames = as_colors(clip, "fvd: clips").permute(0, 3, 1, 2).float()
        frames = F.interpolate(frames, (INPUT_SIZE, INPUT_SIZE), mode="bilinear")
        with exact_convolutions():
            features.append(module((2 * frames - 1).transpose(0, 1)[None])[0].double())
    return torch.stack(features) if features else torch.zeros(0, 400, dtype=torch.float64)


def fvd(a: Tensor, b: Tensor) -> float:
    """Computes the FVD between two sets of clips, [K, T, H, W, 3] each (K at least 2, T at least 10), in [0, 1].

    Symmetric; 0 for equal sets. Biased upwards and noisy below 256 clips: compare only equal numbers of clips.
    """
    return frechet_distance(clip_features(a), clip_features(b))


def frechet_distance(a: Tensor, b: Tensor) -> float:
    """Computes the squared Frechet (2-Wasserstein) distance between Gaussians fitted to two sets of vectors.

    Mean and sample covariance (n - 1), in float64. With centred rows X scaled so that C = X^T X, the trace of
    (C_a C_b)^(1/2) is the sum of singular values of X_a X_b^T, which is exact for singular covariances.

    Args:
        a, b: [N, D] and [M, D], N and M at least 2.

    Raises:
        InputError: shapes are wrong, or vectors are not finite.
    """
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or min(len(a), len(b)) < MIN_CLIPS:
        got = f"{tuple(a.shape)} and {tuple(b.shape)}"
        raise InputError(f"frechet_distance: must be [N, D] and [M, D] with N, M >= 2; got {got}")
    if not (a.isfinite().all() and b.isfinite().all()):
        raise InputError("frechet_distance: vectors must be finite")
    means, roots = [], []
    for rows in (a.double(), b.double()):
        mean = rows.mean(0)
        root = (rows - mean) / (len(rows) - 1) ** 0.5
        means.append(mean)
        roots.append(torch.linalg.qr(root, mode="r").R if len(root) > root.shape[1] else root)
    spread = sum(root.square().sum() for root in roots)
    shared = torch.linalg.svdvals(roots[0] @ roots[1].T).sum()
    return float(((means[0] - means[1]).square().sum() + spread - 2 * shared).clamp(min=0))
