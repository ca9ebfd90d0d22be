"""Generated data sets: layout, determinism, continuation, options, errors and content of scenes."""

import argparse
import dataclasses
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gsim3d import presets
from gsim3d.cli.generate import _part, add_arguments, run
from gsim3d.data import Scene, find_scenes, make_frames
from gsim3d.effects.plan import make_plan
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.synth import generate
from gsim3d.synth.cameras import project
from gsim3d.synth.shapes import PALETTE
from gsim3d.synth.worlds import HELD_OUT, MATERIALS, PRESETS, TINTS, WORLDS, Elastic, build_world
from tests.tolerances import TOLERANCES

SMALL = {
    "image_size": 32, "n_frames": 4, "n_cams": 3, "n_trajectories": 3, "samples": 1, "objects": ("ball", "torus"),
}  # fmt: skip

TINY = {"image_size": 32, "n_cams": 2, "samples": 1}

RECORDED_HEIGHTS = {
    "ball": [0.99818, 0.98924, 0.96327, 0.92026, 0.86023, 0.78316, 0.68906, 0.57793, 0.44977, 0.30458],
    "box": [1.02873, 1.01979, 0.99382, 0.95081, 0.89078, 0.81371, 0.71961, 0.60848, 0.48032, 0.33513],
    "torus": [0.87354, 0.8646, 0.83862, 0.79562, 0.73558, 0.65852, 0.56442, 0.45329, 0.32513, 0.18826],
}  # fmt: skip


def tree_hash(folder: Path) -> str:
    """Hash of all names and bytes of the scenes below ``folder``."""
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(file.relative_to(folder).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "made"
    return out, generate(out, processes=1, progress=False, **SMALL)


def test_generated_folder_layout(made):
    out, report = made
    names = [folder.relative_to(out).as_posix() for folder in report.folders]
    assert names == ["ball/0000", "ball/0001", "torus/0000"] and report.n_made == 3
    assert sorted(os.listdir(out)) == ["ball", "effects.yaml", "manifest.json", "torus"]
    assert len(list(report.folders[0].rglob("*.png"))) == 3 * 3 * 4
    assert find_scenes(out) == report.folders


def test_generated_scenes_are_read_by_scene(made):
    out, report = made
    scene = Scene.open(report.folders[0])
    assert (scene.n_steps, scene.n_cams, scene.width, scene.height) == (4, 3, 32, 32)
    world = build_world("elastic", "mini", SMALL)
    assert (scene.fps, scene.near, scene.far) == (world.fps, world.near, world.far)
    rig = world.rig()
    cameras = scene.cameras_at(range(scene.n_cams), [0])
    np.testing.assert_allclose(cameras.viewmats, rig.viewmats, atol=1e-6)
    np.testing.assert_allclose(cameras.Ks, rig.Ks, atol=1e-4)
    frames = make_frames([scene], [[0, 1, 2]], [[0, 3]])
    assert frames.masks.any() and frames.dynamic.any() and not (frames.dynamic & ~frames.masks).any()
    assert (frames.images.permute(0, 2, 3, 1)[~frames.masks].mean() < 0.1).all()


def test_generated_states_agree_with_labels(made):
    """The box of the body's control grid, projected, holds the body's pixels and is not much larger."""
    for folder in made[1].folders:
        scene = Scene.open(folder)
        states = np.load(folder / "states.npz")["body_0"]
        assert states.dtype == np.float32 and states.shape == (4, 4, 4, 4, 3)
        cameras = scene.cameras_at(range(3), [0])
        viewmats, Ks = (np.asarray(a, dtype=np.float64) for a in (cameras.viewmats, cameras.Ks))
        labels = scene.segmentation(range(3), [0])[0].numpy()
        pixels, _ = project(states[0].reshape(-1, 3).astype(np.float64), viewmats, Ks)
        for cam in range(3):
            y, x = np.nonzero(labels[cam] == 3)
            low, high = pixels[cam].min(0), pixels[cam].max(0)
            assert x.min() >= low[0] - 1 and y.min() >= low[1] - 1
            assert x.max() <= high[0] and y.max() <= high[1]
            assert (high - low < 1.8 * np.array([np.ptp(x) + 1, np.ptp(y) + 1]) + 2).all()


def test_generated_effects_spec_of_each_world(made):
    out, report = made
    spec = EffectsSpec.of_scene(report.folders[0])
    assert spec == EffectsSpec.load(out / "effects.yaml") == build_world("elastic", "mini", {}).effects()
    assert spec.dynamics.background == "frozen" and spec.dynamics.history == 2 and spec.appearance.view_dependent == 0
    for world in WORLDS:
        for subset in ("train", *(name for name, worlds in HELD_OUT["mini"].items() if world in worlds)):
            settings = build_world(world, "mini", {"subset": subset, "depth": True})
            spec = settings.effects()
            assert spec.outputs.depth and (spec.dynamics.background == "masked_out") == (subset == "no-ground")
            model = presets.tiny()
            dynamics = dataclasses.replace(model.dynamics, actions=spec.dynamics.actions)
            plan = make_plan(spec, dataclasses.replace(model, dynamics=dynamics))
            assert spec.dynamics.actions == tuple(dict.fromkeys(settings.actors))
            assert plan.history == 2 and ("background" in plan.on) == settings.ground


def test_generated_manifest(made):
    out, report = made
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["settings"]["image_size"] == 32 and manifest["settings"]["world"] == "elastic"
    assert set(manifest["scenes"]) == {"ball/0000", "torus/0000", "ball/0001"}
    assert manifest["versions"]["mujoco-core"] == "4.0.0" and manifest["machine"]["processor"]
    assert manifest["rejected"] == report.rejected
    for name, entry in manifest["scenes"].items():
        states = np.load(out / name / "states.npz")
        assert states.files == ["body_0"]
        assert entry["states_sha256"] == hashlib.sha256(b"body_0" + states["body_0"].tobytes()).hexdigest()
        digest = hashlib.sha256()
        scene = Scene.open(out / name)
        for step in range(scene.n_steps):
            digest.update(scene.images(range(3), [step])[0].permute(0, 2, 3, 1).flip(-1).contiguous().numpy().tobytes())
            digest.update(scene.segmentation(range(3), [step])[0].contiguous().numpy().tobytes())
            instances = scene.segmentation(range(3), [step])[0].numpy().copy()
            instances[instances == 3] = 2
            digest.update(instances.tobytes())
        assert entry["images_sha256"] == digest.hexdigest()


def test_generate_is_independent_of_processes_and_kills(made, tmp_path):
    out, _ = made
    again = tmp_path / "again"
    half = again / "ball" / ".0001.unfinished" / "cam_0"
    half.mkdir(parents=True)
    (half / "rgb_0000.png").write_bytes(b"half")
    (again / "ball" / "0000").mkdir()
    generate(again, processes=2, progress=False, **SMALL)
    assert tree_hash(again) == tree_hash(out)


def test_generate_keeps_finished_scenes_and_adds_more(made, tmp_path):
    out = tmp_path / "copy"
    shutil.copytree(made[0], out)
    before = {file: file.stat().st_mtime_ns for file in out.rglob("*.png")}
    shutil.rmtree(out / "torus")
    more = {**SMALL, "n_trajectories": 4}
    report = generate(out, processes=1, progress=False, **more)
    assert report.n_made == 2 and len(report.folders) == 4
    assert all(file.stat().st_mtime_ns == before[file] for file in (out / "ball").rglob("*.png"))
    assert tree_hash(out / "torus" / "0000") == tree_hash(made[0] / "torus" / "0000")


def test_generate_refuses_to_mix_options(made):
    with pytest.raises(InputError, match="generated with other options"):
        generate(made[0], processes=1, progress=False, **{**SMALL, "seed": 1})


def test_generate_depends_on_the_seed(made, tmp_path):
    changes = {**SMALL, "n_trajectories": 1, "seed": 1}
    generate(tmp_path, processes=1, progress=False, **changes)
    ours, theirs = (np.load(out / "ball/0000/states.npz")["body_0"] for out in (tmp_path, made[0]))
    assert not np.array_equal(ours, theirs)


@pytest.mark.slow
def test_generate_resumes_after_a_kill(tmp_path):
    """A run whose every process may be killed at any moment goes on to the same bytes."""
    changes = {**SMALL, "n_trajectories": 6, "n_frames": 12}
    generate(tmp_path / "whole", processes=1, progress=False, **changes)
    call = f"generate({str(tmp_path / 'killed')!r}, processes=2, progress=False, **{changes!r})"
    program = f"from gsim3d.synth import generate\nif __name__ == '__main__':\n    {call}\n"
    (tmp_path / "run.py").write_text(program)
    command = [sys.executable, str(tmp_path / "run.py")]
    paths = [os.getcwd(), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    process = subprocess.Popen(command, env=environment)
    deadline = time.time() + 120
    while len(list((tmp_path / "killed").glob("*/*/metadata.json"))) < 2:
        assert time.time() < deadline and process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    while True:  # the workers end by themselves, and with them the last changes in the folder
        snapshot = sorted(str(path) for path in (tmp_path / "killed").rglob("*"))
        time.sleep(2)
        if snapshot == sorted(str(path) for path in (tmp_path / "killed").rglob("*")):
            break
    assert len(list((tmp_path / "killed").glob("*/*/metadata.json"))) < 6
    subprocess.run(command, env=environment, check=True)
    assert tree_hash(tmp_path / "killed") == tree_hash(tmp_path / "whole")


@pytest.fixture(scope="module")
def mini_scenes():
    """First scenes of three jelly bodies, rendered small."""
    world = Elastic(image_size=16, n_cams=2, samples=1)
    return world, [world.make(name, 0) for name in ("ball", "box", "torus")]


def test_elastic_bodies_fall_and_deform(mini_scenes):
    world, scenes = mini_scenes
    assert world.n_frames / world.fps >= 0.9
    for scene in scenes:
        nodes = scene.states["body_0"][..., 2].reshape(world.n_frames, -1)
        used = np.sort(nodes, axis=1)[:, nodes.shape[1] // 4 : -nodes.shape[1] // 4]  # loose corner nodes lie outside
        centre = used.mean(1)
        assert centre[0] - centre.min() > 0.5
        assert centre[-1] - centre.min() > 0.01 or np.ptp(centre[-3:]) < 0.05  # it has landed, and not sunk
    ball = scenes[0].states["body_0"]
    middle = ball[:, 1:3, 1:3, :, 2]
    assert (np.ptp(middle, axis=-1).mean((1, 2)) / np.ptp(middle[0], axis=-1).mean()).min() < 0.8


def test_first_frames_equal_recorded_heights(mini_scenes):
    """Heights of the middle of the body at the first ten frames, as computed on another day elsewhere."""
    _, scenes = mini_scenes
    for scene in scenes:
        heights = scene.states["body_0"][:10, 1:3, 1:3, 1:3, 2].mean((1, 2, 3))
        np.testing.assert_allclose(heights, RECORDED_HEIGHTS[scene.object], atol=TOLERANCES["generate_machines"].value)


@pytest.mark.parametrize("world", ["elastic", "cloth"])
def test_several_materials_are_tinted(world):
    points, found = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)), set()
    for seed in range(30):
        alone, several = (
            build_world(world, "diverse", options)._draw("ball", np.random.default_rng(seed))[2][0]
            for options in ({"materials": ("jelly",)}, {})
        )
        drawn, painted = alone.surface.paint(points), several.surface.paint(points)
        assert {tuple(color) for color in drawn} <= {tuple(color) for color in PALETTE}
        tint = np.array(TINTS[several.facts["material"]])
        np.testing.assert_allclose(painted - tint, 0.4 * (drawn - tint), atol=1e-12)
        found.add(several.facts["material"])
    assert found == set(build_world(world, "diverse", {}).materials) and set(TINTS) == set(MATERIALS)


def test_generate_refuses_impossible_options(tmp_path):
    cases = [
        ({"n_frames": 0}, "n_frames"),
        ({"fps": -1.0}, "fps"),
        ({"drop_height": (2.0, 1.0)}, "drop_height"),
        ({"background": "green"}, "background"),
        ({"objects": ("cube",)}, "cube.*choose from"),
        ({"objects": ()}, "objects"),
        ({"meshes": ("absent.obj",)}, "absent.obj"),
        ({"near": 3.0}, "visible depths of the ground"),
        ({"far": 1.0}, "far must be above near"),
        ({"colour": 1}, "has no option 'colour'"),
        ({"drop_height": (3.0, 4.0)}, "all .* draws were rejected"),
        ({"processes": 0}, "processes"),
        ({"world": "lava"}, "world 'lava'"),
        ({"world": "rigid", "subset": "moon"}, "no set 'moon'.*higher"),
        ({"world": "cloth", "subset": "raised"}, "no set 'raised'"),
        ({"materials": ("steel",)}, "materials must be some of"),
        ({"engine": "havok"}, "engine must be one of mujoco, genesis"),
        ({"world": "rigid", "engine": "genesis"}, "engine must be one of mujoco; got"),
        ({"depth": True, "far": 8.0}, "far must be at most"),
        ({"preset": "huge"}, "preset 'huge'"),
        ({"preset": "paper"}, "paper is now called diverse"),
        ({"ground_albedo": 2.0}, "ground_albedo must be"),
    ]
    for changes, message in cases:
        options = {"processes": 1, **SMALL, **changes}
        with pytest.raises(InputError, match=message):
            generate(tmp_path / "out", progress=False, **options)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="not a folder"):
        generate(tmp_path / "file", progress=False, **SMALL)


def test_generate_locks_its_folder(tmp_path):
    """One that makes the second of two parts, in another process, leaves the first part to others, and no more."""
    hold = "import sys; from pathlib import Path; from gsim3d.io.locks import only_one_writer\n"
    hold += "with only_one_writer(Path(sys.argv[1]), range(1, 3, 2)): print(flush=True), sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], **pipes, cwd=Path.cwd()) as other:
        other.stdout.readline()
        assert generate(tmp_path, processes=1, part=(1, 2), progress=False, **SMALL).n_made == 2
        for part in (None, (2, 2), (2, 3)):
            with pytest.raises(InputError, match="another process is writing to"):
                generate(tmp_path, processes=1, part=part, progress=False, **SMALL)
        other.stdin.close()
    assert generate(tmp_path, processes=1, progress=False, **SMALL).n_made == 1


def test_generate_parts_equal_one_call(made, tmp_path):
    reports = [generate(tmp_path, processes=1, part=(part, 2), progress=False, **SMALL) for part in (2, 1)]
    assert [report.n_made for report in reports] == [1, 2]
    assert [folder.parent.name for folder in reports[0].folders] == ["torus"]
    assert not (tmp_path / "manifest.json").exists()
    assert generate(tmp_path, processes=1, progress=False, **SMALL).n_made == 0
    assert tree_hash(tmp_path) == tree_hash(made[0])
    for part in ((0, 2), (3, 2), (1, 0)):
        with pytest.raises(InputError, match="part must be I/N"):
            generate(tmp_path, processes=1, part=part, progress=False, **SMALL)


def test_slurm_script_generates_a_part(tmp_path):
    (tmp_path / "python").write_text('#!/bin/bash\necho "$*"\n')
    (tmp_path / "python").chmod(0o755)
    slurm = {"ARRAY_TASK_ID": "12", "ARRAY_TASK_MIN": "10", "ARRAY_TASK_COUNT": "4", "CPUS_PER_TASK": "8"}
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", **{f"SLURM_{k}": v for k, v in slurm.items()}}
    command = ["bash", str(Path(__file__).parents[2] / "tools/slurm/generate.sbatch"), "elastic", "--out", "a b"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert _part("3/4") == (3, 4)
    for text in ("3", "a/b", "3/4/5"):
        with pytest.raises(argparse.ArgumentTypeError, match="I/N"):
            _part(text)
    assert done.stdout == "-m gsim3d generate elastic --out a b --part 3/4 --processes 8 --quiet\n"
    assert subprocess.run(command[:2], env=environment, capture_output=True).returncode == 2


def test_presets_build_every_world():
    for preset in PRESETS:
        for world in WORLDS:
            assert build_world(world, preset, {}).scenes()
    for world, length in {"elastic": (84, 42.0), "cloth": (84, 42.0), "rigid": (32, 12.0)}.items():
        for preset in ("published", "diverse"):
            full = build_world(world, preset, {})
            assert (full.n_frames, full.fps) == length and full.image_size == 128 and full.n_cams == 12
        mini, published = build_world(world, "mini", {}), build_world(world, "published", {})
        assert mini == dataclasses.replace(published, n_frames=24, n_trajectories=34)


def test_fingerprint_ignores_later_options_at_defaults():
    """The fingerprint of today's defaults is that of before there were `by_name` and `ground_albedo`."""
    assert Elastic(n_frames=9).fingerprint("ball") == "9f3e7e705993520d240f078b4f98e4553795565c0b370a0101cae9c530d382f8"


@pytest.mark.parametrize("world", ["elastic", "rigid", "cloth"])
def test_published_bodies_are_functions_of_their_names(world):
    settings = build_world(world, "published", {})
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    looks = set()
    for name in settings.object_names():
        drawn = [settings._draw(name, np.random.default_rng(seed)) for seed in range(2)]
        (first,), (second,) = (bodies for _, _, bodies in drawn)
        assert first.facts == {**second.facts, "mass": first.facts["mass"]} and len(drawn[0][2]) == 1
        assert not np.array_equal(first.vertices, second.vertices)
        sampled = points[:, : first.surface.corners.shape[2]]
        looks.add(first.surface.paint(sampled).tobytes())
        np.testing.assert_array_equal(first.surface.paint(sampled), second.surface.paint(sampled))
        if world != "rigid":
            assert first.body.material == second.body.material and not first.body.spin.any()
    assert len(settings.object_names()) == len(looks) == 6
    if world == "cloth":
        cloths = [settings._draw_cloth(np.random.default_rng(seed)) for seed in range(2)]
        assert cloths[0] == cloths[1] and (cloths[0].mass, cloths[0].young) == (0.9, 7e4)
    upright = [settings._draw("spot", np.random.default_rng(seed))[2][0].vertices for seed in range(8)]
    assert np.ptp([np.ptp(vertices[:, 2]) for vertices in upright]) > 0.1  # any rotation, not about the vertical alone


def test_published_ground_is_plain():
    settings = build_world("elastic", "published", {**TINY, "n_frames": 1})
    scene = settings.make("box", 0)
    (view,) = scene.views
    colors, counts = np.unique(view.rgb[view.segmentation == 1], axis=0, return_counts=True)
    assert (colors.max(1) == colors.min(1)).mean() > 0.5 and counts.max() > 0.4 * counts.sum()
    assert (view.rgb[view.segmentation == 0].max(1) == 0).mean() > 0.9


def test_camera_spread_bounds_the_rigs(tmp_path):
    plain, spread = (build_world("elastic", "mini", {**SMALL, **more}) for more in ({}, {"camera_spread": 0.06}))
    assert plain.fingerprint("ball") != spread.fingerprint("ball") and plain.rig(("ball", 1)).n_cams == 3
    np.testing.assert_array_equal(plain.rig(("ball", 1)).viewmats, plain.rig().viewmats)
    np.testing.assert_array_equal(spread.rig().viewmats, plain.rig().viewmats)
    distances, heights, turns = [], [], []
    for sample in range(40):
        rig = spread.rig(("ball", sample))
        np.testing.assert_array_equal(rig.viewmats, spread.rig(("ball", sample)).viewmats)
        rotations = rig.viewmats[:, :3, :3]
        positions = -np.einsum("vji,vj->vi", rotations, rig.viewmats[:, :3, 3])
        aside = np.hypot(*positions[:, :2].T)
        target = positions[0, 2] + aside[0] * rotations[0, 2, 2] / np.hypot(*rotations[0, 2, :2])
        distances.append(np.hypot(aside[0], positions[0, 2] - target) / plain.distance), heights.append(target)
        turns.append(np.arctan2(positions[0, 1], positions[0, 0]))
    assert 0.94 <= min(distances) < 0.95 and 1.05 < max(distances) <= 1.06
    height = 0.03 * plain.distance
    assert plain.target_height - height <= min(heights) < plain.target_height - 0.8 * height
    assert plain.target_height + 0.8 * height < max(heights) <= plain.target_height + height
    assert np.ptp(turns) > 5
    made = generate(tmp_path, preset="mini", processes=1, progress=False, camera_spread=0.06, **SMALL)
    scenes = [Scene.open(folder) for folder in made.folders]
    for scene in scenes:
        found = scene.cameras_at(range(3), [0]).viewmats
        rig = spread.rig((scene.path.parent.name, int(scene.path.name)))
        np.testing.assert_allclose(found, rig.viewmats, atol=1e-6)
    assert len({scene.cameras_at([0], [0]).viewmats.numpy().tobytes() for scene in scenes}) == len(scenes) > 1


def test_world_refuses_ground_beyond_near_and_far():
    build_world("elastic", "mini", {"camera_spread": 0.05})
    with pytest.raises(InputError, match="visible depths of the ground"):
        build_world("elastic", "mini", {"camera_spread": 0.2})
    for spread in (-0.1, 0.3, float("nan")):
        with pytest.raises(InputError, match="camera_spread must be at (most 0.25|least 0)"):
            build_world("elastic", "mini", {"camera_spread": spread})


def test_published_bodies_have_their_share_of_the_mask():
    """Masked scores mean nothing without the share of bodies in the mask. As long as in the sets, of fewer frames."""
    few = {"n_frames": 12, "n_trajectories": 6, "samples": 1}
    elastic = build_world("elastic", "published", {**few, "fps": 6.0, "n_cams": 4, "image_size": 64})
    shares = []
    for scene in elastic.scenes():
        labels = np.stack([view.segmentation for view in elastic.make(*scene).views])
        shares.append((labels == 3).sum() / (labels > 0).sum())
    assert abs(np.mean(shares) - 0.09) < 0.01
    rigid, widths = build_world("rigid", "published", {**few, "fps": 4.5, "n_cams": 4}), []
    for scene in rigid.scenes():
        for view in rigid.make(*scene).views:
            for columns in (view.segmentation == 3).any(1):
                widths.append(np.ptp(np.flatnonzero(columns)) + 1)
    assert np.mean(widths) >= 26


HELD_OUT_SETS = [
    (preset, world, subset)
    for preset in ("published", "diverse")
    for subset, worlds in HELD_OUT[preset].items()
    for world in worlds
]


@pytest.mark.parametrize("preset, world, subset", HELD_OUT_SETS)
def test_held_out_sets_differ_as_documented(preset, world, subset):
    length = {} if subset == "no-ground" else {"n_frames": 2}
    train, other = (build_world(world, preset, {"subset": s, **TINY, **length}) for s in ("train", subset))
    np.testing.assert_array_equal(train.rig().viewmats, other.rig().viewmats)
    name = other.object_names()[0]
    scene = other.make(name, 0)
    bodies, ground = scene.extras["bodies"], scene.extras["ground_height"]
    if subset == "unseen":
        assert not set(other.object_names()) & set(train.object_names())
    else:
        assert other.object_names() == train.object_names()
        seen = dataclasses.replace(train, n_frames=2).make(name, 0).extras["bodies"][0]["size"]
        assert seen != bodies[0]["size"] or train.by_name  # other random numbers
    if subset == "several":
        assert len(bodies) >= 2 and other.n_bodies[1] > train.n_bodies[1]
    if subset == "no-ground":
        assert ground is None and not (np.stack([view.segmentation for view in scene.views]) == 1).any()
        # Corners of a control grid that hold nothing may stay behind; of a rigid body the first node is its origin.
        heights = scene.states["body_0"][..., 2].reshape(len(scene.views), -1)
        heights = heights[:, :1] if world == "rigid" else heights
        bend = np.median(np.diff(heights, 2, axis=0).mean(0)) * other.fps**2
        np.testing.assert_allclose(bend, -9.81, atol=0.6)
        assert np.median(np.abs(np.diff(heights, axis=0)).sum(0)) > 0.7
    if subset == "raised":
        assert ground >= 0.15 and train.ground_height == (0.0, 0.0)
    if subset == "higher":
        assert other.drop_height[1] > train.drop_height[1]


@pytest.mark.parametrize("world", WORLDS)
def test_worlds_repeat_a_scene(world):
    settings = build_world(world, "mini", {**TINY, "n_frames": 6, "depth": True})
    first, second = (settings.make("torus", 1) for _ in range(2))
    has_cloth = world in ("cloth", "cloth-grip")
    assert first.states.keys() == second.states.keys() and ("cloth" in first.states) == has_cloth
    for name, nodes in first.states.items():
        assert np.array_equal(nodes, second.states[name])
    for ours, theirs in zip(first.views, second.views):
        assert np.array_equal(ours.rgb, theirs.rgb) and np.array_equal(ours.depth, theirs.depth)
    labels = np.stack([view.instances for view in first.views])
    assert set(np.unique(labels)) == set(range(2 + len(first.states)))


def test_generated_depth_images(tmp_path):
    """Depth lifted into the world lies on the ground where the ground is shown, and above it elsewhere."""
    import cv2

    report = generate(tmp_path, "rigid", processes=1, progress=False, depth=True, **{**SMALL, "n_trajectories": 1})
    scene = Scene.open(report.folders[0])
    metadata = json.loads((report.folders[0] / "metadata.json").read_text())
    cameras = scene.cameras_at(range(3), [0])
    labels = scene.segmentation(range(3), [3])[0].numpy()
    for cam in range(3):
        stored = cv2.imread(str(report.folders[0] / f"cam_{cam}" / "depth_0003.png"), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16 and ((stored == 0) == (labels[cam] == 0)).all()
        depth = stored * metadata["depth_unit"]
        y, x = np.indices(depth.shape) + 0.5
        K, viewmat = cameras.Ks[cam].double().numpy(), cameras.viewmats[cam].double().numpy()
        local = np.stack([(x - K[0, 2]) / K[0, 0] * depth, (y - K[1, 2]) / K[1, 1] * depth, depth], -1)
        world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
        inner = cv2.erode((labels[cam] == 1).astype(np.uint8), np.ones((3, 3))) > 0
        assert inner.sum() > 20 and np.abs(world[inner, 2]).max() < 2e-3
        assert world[labels[cam] == 3, 2].min() > -0.05 and (labels[cam] == 3).any()


def test_generate_takes_closed_meshes_only(tmp_path):
    vertices = "v 0 0 0\nv 1 0 0\nv 0 0 1\nv 0.3 1 0.3\nv 0 0 0\nv 1 0 0\nv 0.3 -1 0.3\n"  # two stand twice
    faces = "f 5 4 6\nf 2 4 3\nf 3 4 1\nf 1 2 7\nf 6 3 7\nf 3 5 7\n"
    (tmp_path / "closed.obj").write_text(vertices + faces)
    (tmp_path / "open.obj").write_text(vertices + faces.replace("f 3 4 1\n", ""))
    options = {**SMALL, "objects": (), "n_trajectories": 1, "processes": 1, "progress": False}
    for world in ("elastic", "rigid"):
        report = generate(tmp_path / world, world, meshes=(str(tmp_path / "closed.obj"),), **options)
        assert [folder.parent.name for folder in report.folders] == ["closed"]
    with pytest.raises(InputError, match="open.obj is not closed: 3 edges"):
        generate(tmp_path / "out", meshes=(str(tmp_path / "open.obj"),), **options)


def test_rejected_draws_are_counted_and_redrawn(tmp_path):
    """Bodies that are thrown hard leave the view now and then; the scene that is written does not."""
    report = generate(tmp_path, "rigid", processes=1, progress=False, speed=2.5, lift=(2.0, 5.0), **SMALL)
    assert sum(report.rejected.values()) > 0 and set(report.rejected) <= {
        "a body leaves the view of a camera", "a body leaves the ground", "a body leaves the depth range",
    }  # fmt: skip
    for folder in report.folders:
        world = build_world("rigid", "mini", {**SMALL, "speed": 2.5})
        for nodes in np.load(folder / "states.npz").values():
            pixels, _ = project(nodes[:, 0].astype(np.float64), world.rig().viewmats, world.rig().Ks)
            assert pixels.min() > 0 and pixels.max() < world.image_size


def test_missing_genesis_error_names_the_package(tmp_path, monkeypatch):
    monkeypatch.setattr("gsim3d.synth.run.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'gsim3d\[genesis\]'"):
        generate(tmp_path, engine="genesis", processes=1, progress=False, **SMALL)


def test_generate_command(tmp_path, capsys):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    mesh = tmp_path / "pyramid.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nv 0.3 1 0.3\nf 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n")
    text = f"elastic --out {tmp_path / 'out'} --size 16 --frames 2 --fps 30 --trajectories 1 --objects none"
    text += f" --mesh {mesh} --quiet"
    assert run(parser.parse_args([*text.split(), "--drop", "0.5", "0.6", "--background", "white"])) == 0
    assert "1 scene in" in capsys.readouterr().out
    scene = Scene.open(tmp_path / "out" / "pyramid" / "0000")
    assert (scene.n_steps, scene.fps, scene.width) == (2, 30.0, 16)
    assert (scene.images([0], [0])[0, 0, :, 0, 0] == 255).all()
