"""Images that any program can make again, and who has the weights of the perceptual metrics."""

import numpy as np
import pytest
import torch

from gsim3d.evaluate.perceptual import weights


def pattern(seed, n, height, width):
    """[n, H, W, 3] in [0, 1]: waves."""
    i, y, x, c = np.meshgrid(np.arange(n), np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    waves = 0.5 + 0.5 * np.sin(0.37 * (seed + 1) * y + 0.21 * (c + 1) * x + 0.9 * i + seed)
    return torch.from_numpy(waves.astype(np.float32))


def needs(name):
    """Skips a test where the weights ``name`` are not installed, and says how to install them."""
    return pytest.mark.skipif(not weights.installed(name), reason=f"{name}: {weights.how_to_install(name)}")
