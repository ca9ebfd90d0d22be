"""Models and scenes for tests of what rests."""

import dataclasses

import torch

from gsim3d import presets
from gsim3d.simulator import Simulator
from tests.dynamics.scenes import TINY, batch, make_history

ASYMMETRIC = dataclasses.replace(TINY, background="asymmetric")


def make_simulator(config=ASYMMETRIC, seed=0, dtype=torch.float32):
    """A simulator with these dynamics, in evaluation, whose other parts are not called."""
    torch.manual_seed(seed)
    tiny = presets.tiny()
    model = dataclasses.replace(
        tiny,
        encoder=dataclasses.replace(tiny.encoder, dynamic_dim=config.dynamic_latents, static_dim=config.static_latents),
        dynamics=config,
        renderer=dataclasses.replace(tiny.renderer, latents=config.dynamic_latents + config.static_latents),
    )
    return Simulator(model).to(dtype).eval()


def make_scenes(dtype=torch.float32):
    """Scenes of several lengths: mostly background, hardly any, all of it, none."""
    sizes = [((70, 80), 0.8), ((20, 30, 50), 0.1), ((30,), 1.0), ((9, 12), 0.0)]
    return batch([make_history(n, seed=i, frozen_share=f, dtype=dtype) for i, (n, f) in enumerate(sizes)])


def newest_rows(history):
    """bool [N]: rows of the last cloud of each scene."""
    table = history.clouds
    last = [q for q in range(len(table)) if q + 1 == len(table) or table.scenes[q + 1] != table.scenes[q]]
    rows = torch.zeros(history.n_rows, dtype=torch.bool)
    for begin, end in table.row_runs(last):
        rows[begin:end] = True
    return rows
