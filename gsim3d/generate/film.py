"""One trajectory as one array, for those who train while they film; imports no torch."""

from __future__ import annotations

import os

import numpy as np

from gsim3d.generate.run import start_worker
from gsim3d.generate.world import World

NICENESS = 10  # of processes that film: others are waited for


def start_filming() -> None:
    """To be called first in a process that films."""
    os.nice(NICENESS)
    start_worker()


def film(world: World, scene: tuple[str, int], file: str) -> str:
    """Writes trajectory ``scene`` into ``file``, .npy: uint8 [T, V, H, W, 4], colours and the label of seg images."""
    views = world.make(*scene).views
    np.save(file, np.stack([np.concatenate([view.rgb, view.segmentation[..., None]], -1) for view in views]))
    return file
