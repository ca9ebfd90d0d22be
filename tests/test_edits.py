"""Shadows in images of edited scenes are where the lamp and the bodies want them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.data import Scene
from gsim3d.evaluate.physics import true_states
from gsim3d.synth import generate
from gsim3d.synth.render import LIGHT_DIRECTION

ROOT = Path(__file__).parent.parent
SPEC = importlib.util.spec_from_file_location("make_edits", ROOT / "docs" / "make_edits.py")
edits = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(edits)


class FromAbove:
    """A camera 3 m above the origin, 100 pixels a side."""

    def cameras_at(self, cams, steps):
        pose, K = torch.eye(4), torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        pose[1, 1] = pose[2, 2] = -1.0
        pose[2, 3] = 3.0
        return Cameras(pose[None], K[None], torch.ones(1), torch.full((1,), 9.0), torch.tensor([0]), 100, 100)


def body(at):
    g = torch.Generator().manual_seed(0)
    return np.array(at) + 0.15 * (2 * torch.rand(2000, 3, generator=g, dtype=torch.float64).numpy() - 1)


@pytest.mark.parametrize("level", [0.0, 0.2])
def test_darkness_of_the_place_that_a_body_shades(level):
    points = body((0.0, 0.0, 0.9 + level))
    shaded = points - (points[:, 2:] - level) / LIGHT_DIRECTION[2] * LIGHT_DIRECTION
    image = np.full((100, 100, 3), 200, np.uint8)
    assert edits.darkness(image, points, FromAbove(), 0, level) == pytest.approx(0)
    rows, columns = edits.pixels(shaded, FromAbove(), 0).T
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            image[rows + row, columns + column] = 50
    assert edits.darkness(image, points, FromAbove(), 0, level) == pytest.approx(0.75, abs=0.02)
    assert edits.darkness(image, body((0.5, -0.5, 0.9 + level)), FromAbove(), 0, level) < 0.1  # of another body
    assert np.isnan(edits.darkness(image, points - [0, 0, 9], FromAbove(), 0, level))  # below the ground


def test_shadows_of_the_renderer_are_whole(tmp_path):
    options = {"n_trajectories": 1, "n_frames": 5, "objects": ("capsule",), "processes": 1, "progress": False}
    scene = Scene.open(generate(tmp_path, "elastic", preset="published", **options).folders[0])
    (nodes,) = true_states(scene)
    nodes = nodes[3].double().numpy().reshape(-1, 3)
    centre = nodes.mean(0)
    inner = centre + 0.5 * (nodes - centre)  # nodes lie around the body
    image = scene.images([2], [3])[0, 0].permute(1, 2, 0).numpy()
    found = edits.darkness(image, np.repeat(inner, 9, 0), scene, 2, 0.0)
    assert found == pytest.approx(edits.CAST, abs=0.1)
