"""LPIPS, a folded batch norm and the Frechet distance from their definitions, in float64 numpy."""

import numpy as np

# (kernel, stride, padding, pooling before (size, stride 2), compared)
ALEX = [(11, 4, 2, 0, True), (5, 1, 2, 3, True), (3, 1, 1, 3, True), (3, 1, 1, 0, True), (3, 1, 1, 0, True)]
VGG = [
    (3, 1, 1, 2 if i in (2, 4, 7, 10) else 0, i in (1, 3, 6, 9, 12)) for i in range(13)
]  # stages of 2, 2, 3, 3, 3 convolutions


def windows(x, size, stride):
    """[C, h, w, size, size] of [C, H, W]."""
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(1, 2))[:, ::stride, ::stride]


def features(image, layers, weights, biases):
    x = (2 * image.astype(np.float64) - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    x = x.transpose(2, 0, 1)
    taps = []
    for (kernel, stride, padding, pool, tap), weight, bias in zip(layers, weights, biases, strict=True):
        if pool:
            x = windows(x, pool, 2).max((-1, -2))
        x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        x = np.einsum("cyxij,ocij->oyx", windows(x, kernel, stride), weight.astype(np.float64), optimize=True)
        x = np.maximum(x + bias[:, None, None], 0)
        if tap:
            taps.append(x)
    return taps


def lpips_reference(a, b, layers, weights, biases, heads):
    """One pair of images [H, W, 3] in [0, 1]; heads: weights by channel of the compared layers."""
    total = 0.0
    pairs = zip(features(a, layers, weights, biases), features(b, layers, weights, biases), heads, strict=True)
    for fa, fb, head in pairs:
        fa, fb = (f / np.sqrt((f**2).sum(0) + 1e-10) for f in (fa, fb))
        total += ((fa - fb) ** 2 * head[:, None, None]).sum(0).mean()
    return total


def frechet_reference(a, b):
    """Two sets of vectors [N, D] with covariances of full rank."""
    mean = ((a.mean(0) - b.mean(0)) ** 2).sum()
    cov_a, cov_b = (np.atleast_2d(np.cov(x, rowvar=False)) for x in (a, b))
    # The product of two positive definite matrices has positive eigenvalues; its root's trace is that of their roots.
    root = np.sqrt(np.linalg.eigvals(cov_a @ cov_b).real).sum()
    return mean + np.trace(cov_a) + np.trace(cov_b) - 2 * root
