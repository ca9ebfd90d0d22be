"""Physical measures against closed forms."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.evaluate.physics import MEASURES, fall_ratio, measure, measure_particles, shape_change, true_states
from gsim3d.evaluate.report import physics_table, summarize
from gsim3d.evaluate.scoring import SceneScores
from gsim3d.state import DYNAMIC, FROZEN, Particles
from tests.tiny_scenes import write_scene

ONE = torch.zeros(20, dtype=torch.int64)


def cloud(seed=0, n=20):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_free_fall_keeps_its_energy():
    fps = 1000.0
    times = torch.arange(300).double()[:, None, None] / fps
    down = torch.tensor([0.0, 0.0, 1.0]).double()
    points = cloud() + 5 * down + torch.tensor([0.3, 0.0, 0.0]) * times - 0.5 * 9.81 * times**2 * down
    found = measure(points, ONE, fps)
    assert (found["energy"] / found["energy"][0] - 1).abs().max() < 1e-3
    assert found["momentum"][-1].item() == pytest.approx(math.hypot(0.3, 9.81 * 0.2985), rel=1e-3)
    assert found["rigidity"].max() < 1e-9 and found["penetration"].max() == 0 and (found["permanence"] == 1).all()


def test_rigidity_is_of_each_body():
    first, second = cloud(1), cloud(2) + 4
    angle = torch.tensor(2.0).double()
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]]).double()
    points = torch.stack([torch.cat([first, second]), torch.cat([first @ turn.T + 1, second])])
    bodies = torch.arange(40) // 20
    assert measure(points, bodies, 1.0)["rigidity"].item() < 1e-12
    assert measure(points, bodies * 0, 1.0)["rigidity"].item() > 0.1
    mirrored = torch.stack([first, first * torch.tensor([-1.0, 1, 1])])
    assert measure(mirrored, ONE, 1.0)["rigidity"].item() > 0.1
    stretched = torch.stack([first, first.mean(0) + 1.1 * (first - first.mean(0))])
    size = (first - first.mean(0)).square().sum(-1).mean().sqrt().item()
    assert measure(stretched, ONE, 1.0)["rigidity"].item() == pytest.approx(0.1 * size, rel=1e-9)


def test_penetration_and_permanence():
    points = torch.stack([cloud(), cloud()])
    points[1, :5] = torch.tensor([0.0, 0, -0.2]).double()
    points[1, 5:10] = 9.0
    found = measure(points, ONE, 1.0, torch.tensor([[0.0, 0, 0], [1, 1, 1]]))
    assert found["penetration"].item() == pytest.approx(0.05) and found["permanence"].item() == pytest.approx(0.75)


def test_the_shape_of_the_worst_copy():
    generator = np.random.default_rng(2)
    first = torch.from_numpy(generator.normal(size=(30, 3)))
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    turn = torch.from_numpy(turn * np.sign(np.linalg.det(turn)))
    bent = first * torch.tensor([1.0, 1.0, 0.9])
    moved = torch.cat([first @ turn + 3, bent @ turn - 1])
    both = torch.stack([torch.cat([first, first + 2]), moved])
    assert shape_change(both[:, :30]) == pytest.approx(0, abs=1e-12)
    assert shape_change(both, copies=2) == pytest.approx(shape_change(both[:, 30:]))
    assert 0.02 < shape_change(both, copies=2) < 0.2
    assert shape_change(both) > 1  # as one body, whose halves move apart


def test_a_free_body_falls_freely():
    heights = [2 + 1.5 * step / 42 - 9.81 / 2 * (step / 42) ** 2 for step in range(24)]
    assert fall_ratio(heights[:4], heights[23], 20, 42) == pytest.approx(1)
    assert fall_ratio(heights[:4], heights[3], 20, 42) == pytest.approx(0, abs=1e-12)
    assert fall_ratio(heights[:1], heights[20], 20, 42) is None


def test_points_without_steps_are_refused():
    with pytest.raises(InputError, match="points must be"):
        measure(torch.zeros(1, 20, 3), ONE, 1.0)


def test_particles_at_rest_do_not_count(tmp_path):
    scene = Scene.open(write_scene(tmp_path / "a" / "0"))
    activity = torch.tensor([FROZEN, DYNAMIC, DYNAMIC]).float()
    means = torch.zeros(3, 3)
    steps = [means, means + torch.tensor([0.1, 0, 0])]
    particles = Particles(
        means=torch.cat(steps), opacities=torch.ones(6), activity=activity.repeat(2), cu_rows=torch.tensor([0, 3, 6]),
        cloud_scene=torch.zeros(2, dtype=torch.int64), cloud_step=torch.arange(2),
        origin=torch.zeros(1, 3), dynamic_latents=torch.zeros(6, 1), static_latents=torch.zeros(6, 1),
    )  # fmt: skip
    assert measure_particles(particles, scene, 0, None)["momentum"].item() == pytest.approx(0.1 * scene.fps, rel=1e-6)
    still = dataclasses.replace(particles, activity=torch.full((6,), float(FROZEN)))
    assert measure_particles(still, scene, 0, None) == {}


def test_states_of_the_generator(tmp_path):
    scene = Scene.open(write_scene(tmp_path / "a" / "0"))
    assert true_states(scene) is None
    nodes = np.ones((scene.n_steps, 2, 2, 3), np.float32)
    nodes[1:, 0, 0] = 0  # of no cell of the lattice
    np.savez(scene.path / "states.npz", ball=nodes, actors=nodes)
    assert [body.shape for body in true_states(scene)] == [(scene.n_steps, 3, 3)]
    for bad in (np.full((3, 2, 3), np.nan), np.zeros((3, 3)), np.array([{}], dtype=object)):
        np.savez(scene.path / "states.npz", ball=bad)
        with pytest.raises(InputError, match="states.npz"):
            true_states(scene)


def test_report_shows_formulas_and_steps():
    values = {name: torch.arange(4).double() for name in MEASURES}
    scores = SceneScores("a", 2, 6, {"model": {"psnr": torch.ones(6).double()}}, {}, {}, physics={"model": values})
    summary = summarize([scores])
    text = "\n".join(physics_table(summary))
    assert "| momentum [m/s] | model | 0.000 | 2.000 | 3.000 |" in text and "|<v>|" in text
    assert physics_table({**summary, "physics": {}}) == []
