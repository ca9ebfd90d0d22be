"""Scenes far from 0, as of surveys: positions count from a world_offset, which edits and files are given back with."""

import dataclasses

import numpy as np
import pytest
import torch

from gsim3d import presets
from gsim3d.data import make_frames
from gsim3d.data.fitting import Fitting
from gsim3d.data.scene import Scene
from gsim3d.effects.edits import Duplicate, Insert, Move, Rotate, Selection
from gsim3d.errors import InputError
from gsim3d.io import read_ply, write_ply
from gsim3d.simulator import Simulator
from gsim3d.testing.invariances import take_scenes, take_scenes_of_particles
from tests.data import made_scenes

PLACES = [(500000.0, 4649776.0, 100.0), (-1e7, 3.0, 0.0), (0.0, 0.0, 6378137.0), (1e4, -1e4, 0.0)]
WRITERS = ("genesis", "kubric", "transforms", "videos")


def write(folder, layout, monkeypatch, where=(0.0, 0.0, 0.0), moving=False):
    """The synthetic scene, ``where`` away from its position."""
    where = np.asarray(where)
    made = made_scenes.make_scene(moving=moving)
    made.viewmats[..., :3, 3] -= made.viewmats[..., :3, :3] @ where
    origin, bounds = np.array(made_scenes.ORIGIN) + where, np.array(made_scenes.BOUNDS) + where
    extras = made_scenes.EXTRAS | {"origin": origin.tolist(), "bounds": bounds.tolist()}
    monkeypatch.setattr(made_scenes, "EXTRAS", extras)
    getattr(made_scenes, f"write_{layout}")(folder, made)
    return folder


def centers(viewmats):
    viewmats = viewmats.double()
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("where", PLACES[:2])
def test_world_offset_keeps_digits_of_cameras(where, layout, moving, tmp_path, monkeypatch):
    here = Scene.open(write(tmp_path / "here", layout, monkeypatch, moving=moving))
    there = Scene.open(write(tmp_path / "there", layout, monkeypatch, where, moving=moving))
    assert not here.world_offset.any() and there.world_offset.dtype == np.float64
    shift = torch.tensor(where) - torch.from_numpy(there.world_offset)
    assert shift.abs().max() < 3
    cams, steps = range(here.n_cams), range(here.n_steps)
    a, b = here.cameras_at(cams, steps), there.cameras_at(cams, steps)
    torch.testing.assert_close(centers(b.viewmats), centers(a.viewmats) + shift, rtol=0, atol=5e-6)
    torch.testing.assert_close(b.viewmats[:, :3, :3], a.viewmats[:, :3, :3], rtol=0, atol=1e-6)
    for name in ("origin", "bounds"):
        np.testing.assert_allclose(getattr(there, name) + there.world_offset, getattr(here, name) + where, atol=1e-8)
    assert torch.equal(here.images([0], [0]), there.images([0], [0]))
    assert (here.near, here.far) == (there.near, there.far)


@pytest.mark.parametrize("where", PLACES)
def test_world_offset_projects_points_exactly(where, tmp_path, monkeypatch):
    """In float32, too, which absolute coordinates would be pixels off in."""
    scene = Scene.open(write(tmp_path / "a", "transforms", monkeypatch, where))
    point = np.array([0.3, 0.2, 0.4])
    made, cameras = made_scenes.make_scene(), scene.cameras_at(range(scene.n_cams), [0])
    expected = made.Ks[0] @ (made.viewmats[0, :, :3, :3] @ point + made.viewmats[0, :, :3, 3])[..., None]
    local = torch.from_numpy(point + where - scene.world_offset).float()
    seen = cameras.Ks @ (cameras.viewmats[:, :3, :3] @ local + cameras.viewmats[:, :3, 3])[..., None]
    expected, seen = (p[:, :2, 0] / p[:, 2:, 0] for p in (expected, seen.numpy()))
    assert np.abs(expected - seen).max() < 1e-3


def test_world_offset_is_zero_near_the_origin(tmp_path, monkeypatch):
    for name, where in (("a", (0, 0, 0)), ("b", (10.0, 0, 0))):
        scene = Scene.open(write(tmp_path / name, "transforms", monkeypatch, where))
        assert not scene.world_offset.any()
        assert make_frames([scene], [[0, 1]], [[0]]).world_offset is None


def test_world_offset_does_not_change_the_camera_unit(tmp_path, monkeypatch):
    """Not that of its distance from 0."""
    scene = Scene.open(write(tmp_path / "a", "genesis", monkeypatch, PLACES[0]), fitting=Fitting(unit_cameras=True))
    assert 0.2 < scene.near < 1.5
    world = centers(scene.cameras_at(range(scene.n_cams), [0]).viewmats) + torch.from_numpy(scene.world_offset)
    extent = 1 / (scene.near / made_scenes.NEAR)
    made = torch.from_numpy(made_scenes.make_scene().viewmats[0])
    torch.testing.assert_close(world * extent, centers(made) + torch.tensor(PLACES[0]), rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def simulator(one_thread):
    torch.manual_seed(0)
    return Simulator(presets.tiny()).eval()


@pytest.fixture
def two(tmp_path, monkeypatch, simulator):
    """(where, states of the same scene here and there)."""
    scenes = [
        Scene.open(write(tmp_path / name, "genesis", monkeypatch, where))
        for name, where in (("here", (0.0, 0.0, 0.0)), ("there", PLACES[0]))
    ]
    with torch.no_grad():
        states = [simulator.encode(make_frames([scene], [[0, 1, 2]], [[0, 1]])) for scene in scenes]
    return scenes, states


def world(particles):
    return particles.means.double() + (0 if particles.world_offset is None else particles.row_offset())


def test_simulate_writes_world_coordinates(two, simulator, tmp_path):
    _, (here, there) = two
    with torch.no_grad():
        a, b = (simulator.rollout(state, 2)[-1] for state in (here, there))
        torch.testing.assert_close(world(b), world(a) + torch.tensor(PLACES[0]), rtol=0, atol=1e-3)
        write_ply(tmp_path / "b.ply", simulator.renderer(b), 0)
    again = read_ply(tmp_path / "b.ply")
    torch.testing.assert_close(again.means.double() + again.world_offset, world(b), rtol=0, atol=1e-6)


def test_edits_take_world_coordinates(two, simulator):
    _, states = two
    position = np.array([0.3, 0.4, 0.7])
    for operation in (
        lambda p: Rotate("all", degrees=30.0, about=tuple(p.tolist())),
        lambda p: Move(Selection("all", (tuple((p - 0.5).tolist()), tuple((p + 0.5).tolist()))), (0.0, 0.0, 1.0)),
        lambda p: Duplicate("all", (1.0, 0.0, 0.0)),
    ):
        a, b = (
            operation(position + where).apply(state, simulator._colors)
            for state, where in zip(states, ((0.0, 0.0, 0.0), PLACES[0]))
        )
        torch.testing.assert_close(world(b), world(a) + torch.tensor(PLACES[0]), rtol=0, atol=1e-3)
        assert not torch.equal(a.means, states[0].means) and torch.equal(b.world_offset, states[1].world_offset)
    with pytest.raises(InputError, match=r"their bounds are \[\[49999"):
        Move(Selection("all", ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))).apply(states[1], simulator._colors)


def test_inserted_particles_keep_world_positions(two, simulator):
    _, (here, there) = two
    joined = Insert("all", here, PLACES[0]).apply(there, simulator._colors)
    n = there.n_rows
    assert joined.n_rows == 2 * n and torch.equal(joined.world_offset, there.world_offset)
    newest = world(joined)[joined.row_cloud() == 1]
    half = len(newest) // 2
    torch.testing.assert_close(newest[half:], newest[:half], rtol=0, atol=1e-3)
    back = Insert("all", there, tuple(-x for x in PLACES[0])).apply(here, simulator._colors)
    newest = back.means[back.row_cloud() == 1]
    torch.testing.assert_close(newest[half:], newest[:half], rtol=0, atol=1e-3)


def test_world_offset_of_each_scene_of_a_batch(two, simulator):
    scenes, (here, there) = two
    frames = make_frames(scenes, [[0, 1, 2]] * 2, [[0, 1]] * 2)
    assert frames.world_offset.dtype == torch.float64 and not frames.world_offset[0].any()
    with torch.no_grad():
        both = simulator.encode(frames)
    assert torch.equal(both.means[both.row_offset()[:, 0] != 0], there.means)
    assert torch.equal(take_scenes(frames, [1]).world_offset, frames.world_offset[1:])
    assert torch.equal(take_scenes_of_particles(both, [1, 0]).world_offset, both.world_offset.flip(0))
    gaussians = simulator.renderer(both)
    assert gaussians.world_offset.shape == (4, 3) and torch.equal(gaussians.world_offset[2], both.world_offset[1])


@pytest.mark.parametrize("bad", [torch.zeros(2, 3), torch.zeros(1, 3, dtype=torch.float64), float("nan")])
def test_unusable_world_offsets_are_refused(bad, two, simulator):
    scenes, _ = two
    frames = make_frames(scenes, [[0, 1, 2]] * 2, [[0, 1]] * 2)
    bad = torch.full((2, 3), bad, dtype=torch.float64) if isinstance(bad, float) else bad
    with pytest.raises(ValueError, match="world_offset must be"):
        simulator.encode(dataclasses.replace(frames, world_offset=bad))
