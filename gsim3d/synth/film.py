"""One trajectory as one array, for those who train while they film; imports no torch."""

from __future__ import annotations

import os

import numpy as np

from gsim3d.synth.run import start_worker
from gsim3d.synth.world import World

NICENESS = 10  # of processes that film: others are waited for


def start_filming() -> None:
    """To be called first in a process that films."""
    os.nice(NICENESS)
    start_worker()


def film(world: World, scene: tuple[str, int], file: str) -> str:
    """Writes trajectory ``scene`` into ``file``, .npz: images uint8 [T, V, H, W, 4], colours and the label of seg
    images; viewmats [V, 4, 4] and Ks [V, 3, 3] of its cameras."""
    made = world.make(*scene)
    images = np.stack([np.concatenate([view.rgb, view.segmentation[..., None]], -1) for view in made.views])
    np.savez(file, images=images, viewmats=made.rig.viewmats, Ks=made.rig.Ks)
    return file
