"""Physical measures against closed forms."""

import math

import numpy as np
import pytest
import torch

from gsim3d.data import Scene
from gsim3d.data.fitting import Fitting
from gsim3d.errors import InputError
from gsim3d.evaluate.physics import (
    MEASURES,
    TRUE,
    carried,
    fall_ratio,
    measure,
    measure_tracks,
    moving_points,
    shape_change,
    true_states,
)
from gsim3d.evaluate.report import physics_table, summarize, table
from gsim3d.evaluate.scoring import SceneScores
from gsim3d.state import DYNAMIC, FROZEN, Particles
from tests.data.made_scenes import edit_json
from tests.tiny_scenes import write_scene

ONE = torch.zeros(20, dtype=torch.int64)
SPACE = torch.tensor([[-math.inf], [math.inf]]).expand(2, 3)


def cloud(seed=0, n=20):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_free_fall_keeps_its_energy():
    fps = 24.0
    times = torch.arange(12).double()[:, None, None] / fps
    down = torch.tensor([0.0, 0.0, 1.0]).double()
    points = cloud() + 5 * down + torch.tensor([0.3, 0.0, 0.0]) * times - 0.5 * 9.81 * times**2 * down
    found = measure(points, ONE, fps, SPACE)
    assert (found["energy"] / found["energy"][0] - 1).abs().max() < 1e-12
    assert found["momentum"][-1].item() == pytest.approx(math.hypot(0.3, 9.81 * 10.5 / fps), rel=1e-9)
    assert found["rigidity"].max() < 1e-9 and found["penetration"].max() == 0 and (found["permanence"] == 1).all()


def test_rigidity_is_of_each_body():
    first, second = cloud(1), cloud(2) + 4
    angle = torch.tensor(2.0).double()
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]]).double()
    points = torch.stack([torch.cat([first, second]), torch.cat([first @ turn.T + 1, second])])
    bodies = torch.arange(40) // 20
    assert measure(points, bodies, 1.0, SPACE)["rigidity"].item() < 1e-12
    assert measure(points, bodies * 0, 1.0, SPACE)["rigidity"].item() > 0.1
    mirrored = torch.stack([first, first * torch.tensor([-1.0, 1, 1])])
    assert measure(mirrored, ONE, 1.0, SPACE)["rigidity"].item() > 0.1
    stretched = torch.stack([first, first.mean(0) + 1.1 * (first - first.mean(0))])
    size = (first - first.mean(0)).square().sum(-1).mean().sqrt().item()
    assert measure(stretched, ONE, 1.0, SPACE)["rigidity"].item() == pytest.approx(0.1 * size, rel=1e-9)


def test_penetration_and_permanence():
    points = torch.stack([cloud(), cloud()])
    points[1, :5] = torch.tensor([0.0, 0, -0.2]).double()
    points[1, 5:10] = 9.0
    found = measure(points, ONE, 1.0, torch.tensor([[0.0, 0, 0], [1, 1, 1]]))
    assert found["penetration"].item() == pytest.approx(0.05) and found["permanence"].item() == pytest.approx(0.75)
    raised = measure(points, ONE, 1.0, SPACE, ground=0.25)["penetration"].item()
    assert raised == pytest.approx((0.25 - points[1, :, 2]).clamp_min(0).mean().item()) and raised > 0.11
    assert measure(points, ONE, 1.0, SPACE, ground=None)["penetration"].isnan().all()


def test_the_shape_of_the_worst_copy():
    generator = np.random.default_rng(2)
    first = torch.from_numpy(generator.normal(size=(30, 3)))
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    turn = torch.from_numpy(turn * np.sign(np.linalg.det(turn)))
    bent = first * torch.tensor([1.0, 1.0, 0.9])
    moved = torch.cat([first @ turn + 3, bent @ turn - 1])
    both = torch.stack([torch.cat([first, first + 2]), moved])
    copies, one = torch.arange(60) // 30, torch.zeros(60, dtype=torch.int64)
    assert shape_change(both[:, :30], one[:30]) == pytest.approx(0, abs=1e-12)
    assert shape_change(both, copies) == pytest.approx(shape_change(both[:, 30:], one[:30]))
    assert 0.02 < shape_change(both, copies) < 0.2
    assert shape_change(both, one) > 1  # as one body, whose halves move apart
    assert math.isnan(shape_change(both[:, :0], one[:0]))


def test_a_free_body_falls_freely():
    heights = [2 + 1.5 * step / 42 - 9.81 / 2 * (step / 42) ** 2 for step in range(24)]
    assert fall_ratio(heights[:4], heights[23], 20, 42) == pytest.approx(1)
    assert fall_ratio(heights[:4], heights[3], 20, 42) == pytest.approx(0, abs=1e-12)
    assert fall_ratio(heights[:1], heights[20], 20, 42) is None


def test_points_without_steps_are_refused():
    with pytest.raises(InputError, match="points must be"):
        measure(torch.zeros(1, 20, 3), ONE, 1.0, SPACE)


def test_particles_at_rest_do_not_count():
    activity = torch.tensor([FROZEN, DYNAMIC, DYNAMIC]).float()
    means = torch.zeros(3, 3)
    steps = [means, means + torch.tensor([0.1, 0, 0])]
    particles = Particles(
        means=torch.cat(steps), opacities=torch.ones(6), activity=activity.repeat(2), cu_rows=torch.tensor([0, 3, 6]),
        cloud_scene=torch.zeros(2, dtype=torch.int64), cloud_step=torch.arange(2),
        origin=torch.zeros(1, 3), dynamic_latents=torch.zeros(6, 1), static_latents=torch.zeros(6, 1),
    )  # fmt: skip
    assert torch.equal(moving_points(particles, range(2)), torch.stack(steps)[:, 1:])


def spinning(folder, n_steps=6, fps=12.0):
    """A scene above a raised ground whose body moves at 0.3 m/s and turns by 3 rad/s about an axis of its own."""
    scene = Scene.open(write_scene(folder, n_steps=n_steps))
    spin = torch.tensor([[0, -2.4, 0], [2.4, 0, -1.8], [0, 1.8, 0]], dtype=torch.float64)
    turns = torch.linalg.matrix_exp(torch.arange(n_steps)[:, None, None] / fps * spin)
    centres = np.array([0.1, 0.2, 0.7]) + np.arange(n_steps)[:, None] / fps * [0.3, 0, 0]
    axes = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    np.savez(scene.path / "states.npz", body=centres[:, None] + axes @ turns.mT.numpy())
    edit_json(scene.path / "metadata.json", lambda facts: facts.update(ground_height=0.5, fps=fps))
    return Scene.open(scene.path), torch.from_numpy(centres), turns


def test_the_truth_of_a_spinning_body_is_of_its_points(tmp_path):
    scene, centres, turns = spinning(tmp_path / "a" / "0")
    shape = cloud(3) - cloud(3).mean(0)
    true = centres[1:, None] + shape @ turns[1:].mT
    tracks = {"none": true[:, :0], "model": centres[1] + (shape @ turns[1].T).expand_as(true), "other": true}
    found = measure_tracks(tracks, scene, range(1, 6))
    assert list(found) == ["model", "other"]
    truth = {name: found["model"][TRUE + name] for name in MEASURES}
    for name, values in truth.items():
        torch.testing.assert_close(values, found["other"][name], rtol=1e-6, atol=1e-6)
    assert truth["momentum"].numpy() == pytest.approx(0.3) and truth["rigidity"].max() < 1e-7
    chord = 2 * math.sin(1.5 / 12) * 12  # of a turn by 3 rad/s, in m/s at 1 m from the axis
    axis = turns[1] @ torch.tensor([0.6, 0, 0.8]).double()  # the same in all frames
    apart = (shape.square().sum(1) - (shape @ axis).square()).mean()
    energy = (0.09 + chord**2 * apart) / 2 + 9.81 * 0.7
    assert truth["energy"].numpy() == pytest.approx(energy.item())
    at_rest = found["model"]
    assert at_rest["momentum"].max() == 0 and at_rest["energy"].numpy() == pytest.approx(9.81 * 0.7)
    below = (0.5 - tracks["model"][0, :, 2]).clamp_min(0).mean().item()
    assert below > 0 and at_rest["penetration"].numpy() == pytest.approx(below)


def test_each_method_has_the_truth_of_its_own_points(tmp_path):
    scene, centres, turns = spinning(tmp_path / "a" / "0")
    shape = cloud(3) - cloud(3).mean(0)
    tracks = {name: centres[1:, None] + (shape + up) @ turns[1:].mT for name, up in (("model", 0.3), ("springs", 0))}
    found = measure_tracks(tracks, scene, range(1, 6))
    for values in found.values():
        torch.testing.assert_close(values["energy"], values[TRUE + "energy"], rtol=1e-6, atol=1e-6)
    assert (found["model"][TRUE + "energy"] - found["springs"][TRUE + "energy"]).abs().min() > 0.1
    given = [SceneScores(name, 2, 6, {"model": {"psnr": torch.ones(6)}}, {}, {}, physics=found) for name in "ab"]
    energy = found["springs"]["energy"][0].item()
    assert f"| energy [J/kg] | springs | {energy:.3f} of {energy:.3f} |" in "\n".join(physics_table(summarize(given)))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_points_that_are_not_finite_have_no_measures_from_there_on(value):
    points = cloud().expand(5, 20, 3).clone()
    points[3, 7, 1] = value
    for values in measure(points, ONE, 1.0, SPACE).values():
        assert values.isfinite().tolist() == [True, True, False, False]


def test_the_truth_of_fewer_frames(tmp_path):
    scene, centres, _ = spinning(tmp_path / "a" / "0", n_steps=9)
    half = Scene.open(scene.path, fps=6.0)
    assert half.n_steps == 5 and torch.equal(true_states(half)[0][:, 0], centres[::2])
    assert true_states(Scene.open(scene.path, fitting=Fitting(unit_cameras=True))) is None
    for height, said in (("0.5", "must be metres or null; got '0.5'"), (True, "got True")):
        edit_json(scene.path / "metadata.json", lambda facts, height=height: facts.update(ground_height=height))
        with pytest.raises(InputError, match=said):
            assert Scene.open(scene.path).ground_height


def test_states_of_the_generator(tmp_path):
    scene = Scene.open(write_scene(tmp_path / "a" / "0"))
    assert true_states(scene) is None
    nodes = np.ones((scene.n_steps, 2, 2, 3), np.float32)
    nodes[1:, 0, 0] = 0  # of no cell of the lattice
    np.savez(scene.path / "states.npz", ball=nodes, actors=nodes)
    assert [body.shape for body in true_states(scene)] == [(scene.n_steps, 3, 3)]
    lattice = np.stack(np.meshgrid(*[np.arange(3.0)] * 3, indexing="ij"), -1) + 1
    bent = lattice + 0.1 * np.sin(3 * lattice[..., [2, 0, 1]])
    np.savez(scene.path / "states.npz", jelly=np.stack([lattice, bent] * scene.n_steps)[: scene.n_steps])
    assert [body.shape for body in true_states(scene)] == [(scene.n_steps, 3, 3, 3, 3)]
    centers = torch.from_numpy((lattice[:-1, :-1, :-1] + 0.5).reshape(-1, 3))
    moved, body = carried(centers, true_states(scene))
    around = np.lib.stride_tricks.sliding_window_view(bent, (2, 2, 2), (0, 1, 2)).reshape(8, 3, 8).mean(2)
    assert body.tolist() == [0] * 8
    torch.testing.assert_close(moved[1], torch.from_numpy(around))
    torch.testing.assert_close(moved[2], centers)
    np.savez(scene.path / "states.npz", actors=nodes)
    assert true_states(scene) is None
    for bad in (np.full((9, 2, 3), np.nan), np.zeros((9, 3)), np.array([{}], dtype=object), nodes[1:]):
        np.savez(scene.path / "states.npz", ball=bad)
        with pytest.raises(InputError, match="states.npz"):
            true_states(scene)


def test_report_shows_formulas_and_steps():
    values = {name: torch.arange(4).double() for name in MEASURES} | {"penetration": torch.full((4,), math.nan)}
    scores = SceneScores("a", 2, 6, {"model": {"psnr": torch.ones(6).double()}}, {}, {}, physics={"model": values})
    summary = summarize([scores])
    text = "\n".join(physics_table(summary))
    assert "| momentum [m/s] | model | 0.000 | 2.000 | 3.000 |" in text and "|<v>|" in text
    assert "| penetration [m] | model | - | - | - |" in text
    assert physics_table({**summary, "physics": {}}) == []


def test_columns_stand_below_each_other():
    values = {name: {"psnr": torch.ones(6).double()} for name in ("copy", "spring-gaus-given-object")}
    lines = table(summarize([SceneScores("a", 2, 6, values, {}, {})])).splitlines()
    assert len({len(line) for line in lines if line.endswith(("1.00", "PSNR"))}) == 1
