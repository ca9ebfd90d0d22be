"""The command capture: refusals with reasons, decisions, prepared scenes, skipped steps."""

import json
import os
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from gsim3d.capture import check, prepare
from gsim3d.capture.run import _Run, capture
from gsim3d.cli.main import main
from gsim3d.data import Scene, find_scenes
from gsim3d.data.masks import background_image, foreground
from gsim3d.errors import InputError
from gsim3d.nn.multiview_encoder import Encoder, EncoderConfig
from gsim3d.nn.multiview_encoder.config import ViTConfig
from gsim3d.train.config import TrainConfig
from gsim3d.train.restore import restore
from tests.capture.made_clips import rig, write_textured_clips
from tests.capture.made_takes import cameras_at, write_take
from tests.data.made_hocap import write_hocap


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_take(folder / "ball", starts=(0, 2, 1))
    patch = pytest.MonkeyPatch()
    patch.setattr("gsim3d.capture.run.PROBED", 1)
    patch.setattr("gsim3d.capture.run.PHASES", ((0, 0.5, 2e-3), (2, 0.5, 1e-3)))
    assert main(["capture", str(folder / "ball"), "--out", str(folder / "my run"), "--minutes", "0.01"]) == 0
    patch.undo()
    return folder / "my run"


def test_capture_ends_with_a_score_and_skips_what_is_done(run, capsys):
    scores = json.loads((run / "metrics.json").read_text())
    assert scores["windows"] >= 1 and np.isfinite(scores["gain"])
    assert scores["steps"] >= 2 and len(scores["of_windows"]["constant"]) == scores["windows"]
    before = (run / "model" / "metrics.jsonl").stat().st_mtime_ns
    arguments = ["capture", str(run.parent / "ball"), "--out", str(run), "--minutes"]
    assert main([*arguments, "0.01", "--scale", "left", "right", "1"]) == 0
    said = capsys.readouterr().out
    assert "--board and --scale have no effect: delete cameras.json" in said
    assert all(f"{step}: done" in said for step in ("check", "propose", "settings", "train", "score"))
    assert f"gsim3d view '{run}/scenes/test/ball' --checkpoint '{run}/model'" in said
    assert (run / "model" / "metrics.jsonl").stat().st_mtime_ns == before
    assert main([*arguments, "15"]) == 2
    assert "was started with minutes 0.01; give the same, or another --out" in capsys.readouterr().err
    assert main(["capture", str(run), "--out", str(run), "--minutes", "0.01"]) == 2
    assert "was started with DIR ../ball; give the same" in capsys.readouterr().err


def test_a_step_whose_file_is_deleted_is_repeated_with_those_below(tmp_path):
    steps, said = _Run(tmp_path, tmp_path, "cpu", 1.0, None, False, lambda _: None), []
    for deleted, repeated in ((None, ["propose", "settings", "score"]), ("settings.json", ["settings", "score"])):
        if deleted:
            (tmp_path / deleted).unlink()
        said.clear()
        for name in ("propose", "settings", "score"):
            steps.step(name, lambda name=name: said.append(name) or {})
        assert said == repeated
    (tmp_path / "model").mkdir()
    with pytest.raises(InputError, match="scenes"):
        steps.settings({})
    assert not (tmp_path / "model").exists()  # a new training does not continue the old one


def bare_run(folder, out, say=lambda _: None, depth=None, force=False):
    out.mkdir(exist_ok=True)
    return _Run(folder, out, "cpu", 1.0, depth, force, say)


def edit_cameras(folder, change):
    content = json.loads((folder / "cameras.json").read_text())
    change(content["cameras"])
    (folder / "cameras.json").write_text(json.dumps(content))


def test_a_run_belongs_to_its_clips_cameras_and_depth(tmp_path):
    take, depth = write_take(tmp_path / "videos" / "a", n_frames=4), tmp_path / "model.safetensors"
    depth.write_bytes(b"one")
    run = bare_run(tmp_path / "videos", tmp_path / "run", depth=("tiny", str(depth)))
    (run.out / "check.json").write_text("{}")
    (run.out / "capture.json").write_text(json.dumps(run.given()))
    run.check_same()
    clip, cameras = take / "left.avi", take / "cameras.json"
    for file, change in (
        (depth, lambda: depth.write_bytes(b"two")),
        (clip, lambda: clip.write_bytes(clip.read_bytes() + b"0")),
        (cameras, lambda: edit_cameras(take, lambda entries: entries[0].update(offset=0.5))),
        (cameras, cameras.unlink),
    ):
        kept, times = file.read_bytes(), (file.stat().st_atime, file.stat().st_mtime)
        change()
        with pytest.raises(InputError, match=rf"started with \S*{file.name} .*delete .*check.json to begin anew"):
            run.check_same()
        file.write_bytes(kept)
        os.utime(file, times)
        run.check_same()
    cameras.unlink()
    (run.out / "check.json").unlink()
    run.check_same()


def test_given_cameras_are_kept(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("gsim3d.capture.run.calibrate", lambda folder, **_: calls.append(folder))
    clip = write_take(tmp_path / "a", n_frames=4) / "left.avi"
    for inner in ("original", "masks"):
        (tmp_path / "a" / inner).mkdir()
        shutil.copy(clip, tmp_path / "a" / inner)
    bare_run(tmp_path / "a", tmp_path / "run").calibrate(None, None)
    mixed = bare_run(tmp_path, tmp_path / "run")
    mixed.calibrate(None, None)
    write_take(tmp_path / "b", n_frames=4).joinpath("cameras.json").unlink()
    with pytest.raises(InputError, match=r"b: has videos but no cameras.json, unlike \S*a: give its cameras"):
        mixed.calibrate(None, None)
    assert not calls
    (tmp_path / "run" / "calibrating").touch()  # an interrupted call wrote those of a
    mixed.calibrate(None, None)
    assert calls == [tmp_path] and not (tmp_path / "run" / "calibrating").exists()


def test_every_take_is_checked(tmp_path, monkeypatch):
    write_take(tmp_path / "videos" / "a", n_frames=16)
    write_take(tmp_path / "videos" / "b", (0, 60, 180), n_frames=16)
    run = bare_run(tmp_path / "videos", tmp_path / "run")
    with pytest.raises(InputError, match="videos/b: the views do not overlap"):
        run.check()
    edit_cameras(tmp_path / "videos" / "b", lambda entries: entries.reverse())
    with pytest.raises(InputError, match=r"videos/b: has cameras right, middle, left .* other takes left, middle"):
        run.check()
    shutil.rmtree(tmp_path / "videos" / "b")
    monkeypatch.setattr("tests.capture.made_takes.SIZE", 80)
    write_take(tmp_path / "videos" / "b", n_frames=16)
    with pytest.raises(InputError, match=r"videos/b: has cameras .*\(80, 80\).* pixels, other takes .*\(96, 96\)"):
        run.check()


def test_an_unknown_model_of_depth_is_refused_by_its_option(tmp_path):
    with pytest.raises(InputError, match="^--depth: MODEL must be one of tiny, .*; got 'dinov2_smal'; did you mean"):
        capture(tmp_path, tmp_path / "run", depth=("dinov2_smal", "weights.safetensors"))


def test_depths_are_those_of_the_cameras_of_each_take(tmp_path):
    for name in ("a", "b"):
        write_take(tmp_path / name, n_frames=24)
    edit_cameras(tmp_path / "b", lambda entries: [own.update(T=[3 * x for x in own["T"]]) for own in entries])
    takes = [prepare.open_take(tmp_path / name, tmp_path / "cache") for name in ("a", "b")]
    assert prepare._depths(takes)[1] > 2 * prepare._depths(takes[:1])[1]


def test_a_repeated_proposal_leaves_no_old_scenes(tmp_path):
    for name in ("b", "c"):
        write_take(tmp_path / "videos" / name, n_frames=16)
    run = bare_run(tmp_path / "videos", tmp_path / "run")
    run.propose()
    write_take(tmp_path / "videos" / "a", n_frames=16)
    run.propose()
    train, test = ([path.name for path in run.scenes(part)] for part in ("train", "test"))
    assert train == ["b", "c"] and test == ["a"]


def test_training_is_saved_every_minute(tmp_path, monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr("gsim3d.capture.run.time.perf_counter", lambda: next(clock) / 2)
    trainer = SimpleNamespace(train_step=lambda: None, simulator=SimpleNamespace(train=lambda: None))
    monkeypatch.setattr("gsim3d.capture.run.Trainer", lambda *_, **__: trainer)
    assert bare_run(tmp_path, tmp_path / "run")._timed(TrainConfig(), []).checkpoint_every == 120


def test_pretrained_depth_is_trained_on(run, tmp_path, monkeypatch, capsys):
    encoder = Encoder(EncoderConfig(backbone="vit_dpt", vit=ViTConfig("tiny")))
    weights = {name: value.contiguous() for name, value in encoder.depth.backbone.state_dict().items()}
    save_file(weights, tmp_path / "tiny.safetensors")
    monkeypatch.setattr("gsim3d.capture.run.PROBED", 1)
    monkeypatch.setattr("gsim3d.capture.run.PHASES", ((0, 1.0, 2e-3),))
    arguments = ["capture", str(run.parent / "ball"), "--out", str(tmp_path / "run"), "--minutes", "0.001", "--depth"]
    assert main([*arguments, "tiny", str(tmp_path / "none.safetensors")]) == 2
    assert "none.safetensors: no such file" in capsys.readouterr().err
    assert main([*arguments, "tinny", str(tmp_path / "tiny.safetensors")]) == 2
    assert "did you mean tiny?" in capsys.readouterr().err and not (tmp_path / "run").exists()
    assert main([*arguments, "tiny", str(tmp_path / "tiny.safetensors")]) == 0
    kept = restore(tmp_path / "run" / "model", "cpu").simulator.encoder.depth.backbone.state_dict()
    assert torch.equal(kept["cls_token"], encoder.depth.backbone.cls_token)


def test_takes_of_equal_names_stay_apart(tmp_path):
    for body in ("ball", "box"):
        write_take(tmp_path / "videos" / body / "0000", n_frames=24)
    run = _Run(tmp_path / "videos", tmp_path / "run", "cpu", 1.0, None, False, lambda _: None)
    run.propose()
    assert [path.name for path in run.scenes("train")] == ["box_0000"]
    assert [path.name for path in run.scenes("test")] == ["ball_0000"]


def test_takes_that_are_too_short_are_named(tmp_path):
    for name, n_frames in (("a", 24), ("b", 24), ("c", 6)):
        write_take(tmp_path / "videos" / name, n_frames=n_frames)
    run = _Run(tmp_path / "videos", tmp_path / "run", "cpu", 1.0, None, False, lambda _: None)
    with pytest.raises(InputError, match=r"videos/c: has 3 usable frames at 15 a second, needs 4"):
        run.propose()


def test_files_that_are_missing_are_named(tmp_path, capsys):
    folder = write_take(tmp_path / "ball", n_frames=16)
    arguments = ["capture", str(folder), "--out", str(tmp_path / "run")]
    for name in ("left", "middle"):
        (folder / "masks" / name).mkdir(parents=True)
        for frame in range(16):
            cv2.imwrite(str(folder / "masks" / name / f"{frame}.png"), np.full((96, 96), 255, np.uint8))
    assert main(arguments) == 2
    assert f"camera right has no images <number>.png or .jpg in {folder / 'masks' / 'right'}" in capsys.readouterr().err
    shutil.rmtree(folder / "masks")
    (folder / "right.avi").rename(folder / "extra.avi")
    assert main(arguments) == 2
    assert "camera right needs a folder right" in capsys.readouterr().err
    shutil.copy(folder / "left.avi", folder / "right.avi")
    assert main(arguments) == 2
    assert "cameras.json: has no camera of extra.avi" in capsys.readouterr().err


def test_prepared_scenes_are_cropped_and_synchronised_with_their_cameras(run):
    (train,), (test,) = (find_scenes(run / "scenes" / part) for part in ("train", "test"))
    scene, proposal = Scene.open(train), json.loads((run / "proposal.json").read_text())
    assert scene.fps == 15 and scene.n_cams == 3 and [scene.width, scene.height] == proposal["size"]
    assert proposal["held_out_camera"] is None
    time = 2 / 30  # the latest video begins at frame 2
    low, high = scene.bounds
    for step in (0, 5):
        at = time + step / 15
        center = np.array([0.5 * np.sin(3 * at), 0.45 * np.cos(2.3 * at + 0.5), 0.5 + 0.15 * np.sin(5 * at)])
        assert (low < center).all() and (center < high).all()
        viewmats, Ks = scene.recording.cameras_at_step(step)
        masks = scene.segmentation(range(3), [step])[0].numpy() == 3
        for viewmat, K, mask in zip(viewmats, Ks, masks, strict=True):
            pixel = K @ (viewmat[:3, :3] @ center + viewmat[:3, 3])
            seen = np.argwhere(mask)[:, ::-1].mean(0) + 0.5
            assert np.linalg.norm(pixel[:2] / pixel[2] - seen) < 1.0
    assert Scene.open(test).n_steps + scene.n_steps == 36 - 1
    corners = np.array([[x, y, 1] for x in (0, scene.width) for y in (0, scene.height)])
    for viewmat, K in zip(*scene.recording.cameras_at_step(0), strict=True):  # wherever depth errs, in the workspace
        local = corners @ np.linalg.inv(K).T * scene.far
        assert ((local - viewmat[:3, 3]) @ viewmat[:3, :3] >= scene.origin - 1e-6).all()


def test_views_far_apart_are_refused_with_their_angles(tmp_path, capsys):
    write_take(tmp_path / "ball", (0, 55, 180), n_frames=16)
    arguments = ["capture", str(tmp_path / "ball"), "--out", str(tmp_path / "run")]
    assert main(arguments) == 2
    message = capsys.readouterr().err
    angles = check.angles(np.stack(cameras_at((0, 55, 180))))
    assert f"left-middle {angles[0, 1]:.0f}, left-right {angles[0, 2]:.0f}" in message
    assert "--force" in message and not (tmp_path / "run" / "check.json").exists()
    assert main([*arguments, "--minutes", "3"]) == 2  # nothing was started yet
    assert "do not overlap" in capsys.readouterr().err


def test_a_wrong_camera_is_refused_by_the_error_of_matches(tmp_path):
    cameras = rig((-15, 0, 15), 1.0)
    write_textured_clips(tmp_path, cameras)
    entries = [
        {"name": name, "size": [400, 300], "K": K.tolist(), "R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
        for name, K, pose in cameras
    ]

    def problem():
        (tmp_path / "cameras.json").write_text(json.dumps({"pixel_center": 0, "cameras": entries}))
        scene = Scene.open(tmp_path)
        errors = check.match_errors(scene, check.angles(scene.recording.viewmats[0]))
        assert errors
        return check.fit_problem(errors, scene.width)

    assert problem() is None
    turn = cv2.Rodrigues(np.array([0.04, 0.0, 0.0]))[0]
    entries[1] |= {key: (turn @ np.array(entries[1][key])).tolist() for key in ("R", "T")}
    assert "does not fit" in problem() and "cam0-cam1" in problem() and "px" in problem()


@pytest.mark.parametrize("degrees, offset", [(0, 0.0), (3, 0.0), (0, 0.4)])
def test_a_wrong_camera_or_time_is_refused_by_moving_bodies(tmp_path, degrees, offset):
    def change(entries):
        turn = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
        entries[1] |= {key: (turn @ np.array(entries[1][key])).tolist() for key in ("R", "T")}
        entries[1]["offset"] += offset

    edit_cameras(write_take(tmp_path / "ball"), change)
    run = bare_run(tmp_path / "ball", tmp_path / "run")
    if degrees or offset:
        with pytest.raises(InputError, match=r"rays through the centres of the moving bodies miss .* px \(at most"):
            run.check()
    else:
        assert not run.check()["ignored"]


def test_what_cannot_be_judged_or_used_is_said(tmp_path):
    said = []
    bare_run(write_take(tmp_path / "ball", n_frames=8, masks="none"), tmp_path / "run", said.append).check()
    assert "nothing shows whether the calibration fits" in said[0]
    write_hocap(tmp_path / "hocap", n_frames=8)
    bare_run(tmp_path / "hocap", tmp_path / "run", said.append).check()
    assert "points of actors are not used" in said[-1]


def test_a_floor_of_equal_tiles_does_not_refuse_a_calibration(tmp_path):
    scene = Scene.open(write_hocap(tmp_path, n_frames=2))
    errors = check.match_errors(scene, check.angles(scene.recording.viewmats[0]))
    assert errors and check.fit_problem(errors, scene.width) is None


def test_force_goes_on_and_keeps_what_was_ignored(tmp_path):
    write_take(tmp_path / "ball", (0, 60, 180), n_frames=16)
    said = []
    checked = _Run(tmp_path / "ball", tmp_path, "cpu", 1.0, None, True, said.append).check()
    assert any("ignored, because of --force: the views do not overlap" in line for line in said)
    assert len(checked["ignored"]) == 1


def test_with_four_cameras_the_most_surrounded_is_held_out(tmp_path):
    write_take(tmp_path / "ball", (0, 20, 40, 60), n_frames=24)
    said = []
    proposal = prepare.propose([prepare.open_take(tmp_path / "ball", tmp_path / "cache")], "cpu", said.append)
    assert proposal.held_out_camera in (1, 2)
    assert any("held out: camera middle" in line or "held out: camera right" in line for line in said)


def test_a_body_that_rests_and_leaves_is_no_ghost():
    rng = np.random.default_rng(0)
    scenery = cv2.resize(rng.integers(40, 200, (12, 16, 3)).astype(np.uint8), (128, 96), interpolation=cv2.INTER_LINEAR)
    frames = np.repeat(scenery[None], 40, 0)
    for step in range(40):
        x = 30 if step < 26 else 30 + 6 * (step - 25)  # rests for 65 % of the video
        if x < 120:
            frames[step, 30:60, x : x + 24] = (250, 20, 30)
    frames = (frames + rng.normal(0, 2, frames.shape)).clip(0, 255).astype(np.uint8)
    background = background_image(lambda steps: frames[list(steps)], 40)
    assert np.abs(background.astype(int) - scenery).mean() < 2
    for step in (3, 39):
        mask, body = foreground(frames[step], background), (frames[step, ..., 0] > 200) & (frames[step, ..., 1] < 60)
        assert (mask & ~body).mean() < 0.02 and mask[body].all()
