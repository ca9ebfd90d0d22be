"""Worlds with actors: recorded points, lengths of motions, determinism, and files that check-data accepts."""

import json

import numpy as np
import pytest

from gsim3d.data import Scene
from gsim3d.data.check import check_scene
from gsim3d.errors import InputError
from gsim3d.synth import generate
from gsim3d.synth.pushing import PUSHER_RADIUS
from gsim3d.synth.scene_setup import Unstable
from gsim3d.synth.world import Rejected
from gsim3d.synth.worlds import WORLDS, build_world

SMALL = {"image_size": 32, "n_frames": 6, "n_cams": 2, "n_trajectories": 2, "samples": 1}


@pytest.fixture(scope="module")
def pushes(tmp_path_factory):
    return generate(tmp_path_factory.mktemp("pushes"), "push", processes=1, progress=False, **SMALL).folders


def test_push_scenes_record_the_center_of_the_pusher_and_points_on_its_surface(pushes):
    for folder in pushes:
        assert not check_scene(folder).problems
        scene, states = Scene.open(folder), np.load(folder / "states.npz")
        actions = scene.recording.actions
        assert actions.types == ("pusher",) * 27 and actions.positions.shape == (6, 27, 3)
        np.testing.assert_array_equal(actions.positions, states["actors"])
        np.testing.assert_allclose(actions.positions[:, 0, 2], PUSHER_RADIUS, atol=1e-6)
        arms = actions.positions[:, 1:] - actions.positions[:, :1]
        np.testing.assert_allclose(np.linalg.norm(arms, axis=2), PUSHER_RADIUS, atol=1e-6)
        np.testing.assert_allclose(arms, np.broadcast_to(arms[0], arms.shape), atol=1e-6)  # it does not turn
        ways = {tuple(way) for way in np.sign(arms[0].round(5)).astype(int).tolist()}
        assert len(ways) == 26 and (0, 0, 0) not in ways
        steps = np.linalg.norm(np.diff(actions.positions[:, 0], axis=0), axis=1) * scene.fps
        assert (steps < 0.5 + 1e-5).all() and (steps > 0.3 - 1e-5).all()
        seen = scene.cameras_at([0], [3])
        local = seen.viewmats[0].double().numpy() @ np.array([*actions.positions[3, 0], 1.0])
        x, y = (seen.Ks[0].double().numpy() @ local[:3])[:2] / local[2]
        assert scene.segmentation([0], [3])[0, 0, int(y), int(x)] == 3  # it is seen as a body


def test_sets_with_other_points_have_another_version(pushes):
    """Sets of push whose only point is the center are not continued; those of other worlds are."""
    manifest = json.loads((pushes[0].parents[1] / "manifest.json").read_text())
    facts = json.loads((pushes[0] / "metadata.json").read_text())
    versions = {name: build_world(name, "mini", {}).generator_version for name in WORLDS}
    assert manifest["generator_version"] == facts["generator_version"] == versions.pop("push") == 4
    assert set(versions.values()) == {3}
    world = build_world("push", "mini", {})
    older = type("Older", (type(world),), {"generator_version": 3})()
    assert older.fingerprint("box") != type(world)().fingerprint("box")


def test_pushes_are_long_and_their_pushers_start_clear_of_bodies():
    world, pushed, scripted = build_world("push", "published", {"n_cams": 2}), [], 0
    for scene in [(name, sample) for sample in range(5) for name in world.object_names()]:
        for attempt in range(10):
            drawn = world.draw(*scene, attempt)
            centers = [(body.vertices[:, :2].min(0) + body.vertices[:, :2].max(0)) / 2 for body in drawn.bodies]
            assert min(np.linalg.norm(centers - drawn.policy.start, axis=1)) > 0.3
            _, moved = world.simulate(drawn)
            try:
                world._check_trajectory(world.rig(), drawn, moved)
            except (Unstable, Rejected):
                continue
            break
        scripted += drawn.policy.legs[0][0] >= 0
        pushed.append(max(np.linalg.norm((body[-1] - body[0]).mean(0)[:2]) for body in moved[:-1]))
        again = world.simulate(world.draw(*scene, attempt))[1]
        assert all(np.array_equal(a, b) for a, b in zip(moved, again))
    assert np.median(pushed) > 0.25 and 10 <= scripted < 20


@pytest.mark.parametrize("name, n_points", [("cloth-grip", {1, 2}), ("hands", {42})])
def test_scenes_with_grippers_and_hands_are_read(name, n_points, tmp_path):
    options = SMALL | {"n_trajectories": 3, "image_size": 48, "n_frames": 5}
    report, found = generate(tmp_path, name, processes=1, progress=False, **options), set()
    for folder in report.folders:
        assert not check_scene(folder).problems
        actions = Scene.open(folder).recording.actions
        assert actions.types == build_world(name, "mini", {}).actors[: len(actions.types)]
        np.testing.assert_array_equal(actions.positions, np.load(folder / "states.npz")["actors"])
        found.add(len(actions.types))
    assert found == n_points


def test_cloth_follows_its_grippers():
    world = build_world("cloth-grip", "published", {"n_cams": 2, "n_frames": 10})
    for sample in range(2):
        drawn = world.draw("cloth", sample, 0)
        (cloth, grips), moved = world.simulate(drawn)
        world._check_trajectory(world.rig(), drawn, moved)
        held = cloth.nodes.reshape(10, -1, 3)[:, list(drawn.cloth.held)]
        assert np.abs(held - grips.nodes).max() < 0.02  # inside the grippers
        assert np.linalg.norm(np.diff(grips.nodes, axis=0), axis=2).sum(0).max() > 0.15
        assert cloth.nodes[..., 2].min() > -0.01 and np.ptp(cloth.nodes[0, ..., 2]) > 0.2  # it hangs


def test_hands_carry_the_body():
    world = build_world("hands", "published", {"n_cams": 2})
    lifted = []
    for sample in range(3):
        drawn = world.draw("box", sample, 0)
        (body, hands), (vertices, _) = world.simulate(drawn)
        assert hands.nodes.shape == (32, 42, 3) and hands.nodes[..., 2].min() > 0
        axes = body.nodes[:, 1:] - body.nodes[:, :1]
        np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (32, 3, 3)), atol=1e-9)
        held = drawn.policy.apart == 0
        local = np.einsum("tij,tnj->tni", axes, hands.nodes - body.nodes[:, :1])[held]
        assert len(local) >= 10 and np.linalg.norm(local, axis=2).min() > 0.05
        wrists = local[:, [0, 21]]
        np.testing.assert_allclose(wrists, np.broadcast_to(wrists[0], wrists.shape), atol=1e-9)  # fixed to the body
        bones = np.linalg.norm(np.diff(hands.nodes[:, 1:5], axis=1), axis=2)
        np.testing.assert_allclose(bones, np.broadcast_to(bones[0], bones.shape), atol=1e-9)
        assert (vertices[..., 2].min(1) > -0.01).all()
        lifted.append(np.ptp(vertices[..., 2].mean(1)))
    assert min(lifted) > 0.1


@pytest.mark.parametrize(
    "name, option", [("push", "meshes"), ("push", "drop_height"), ("hands", "n_bodies"), ("cloth-grip", "body_size")]
)
def test_options_without_effect_are_refused(name, option):
    with pytest.raises(InputError, match=f"world '{name}' does not use the option '{option}'"):
        build_world(name, "mini", {option: (0.1, 0.2)})
