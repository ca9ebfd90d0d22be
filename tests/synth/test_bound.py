"""`gsim3d bound`: reproduction without errors, magnitudes of errors, summary, continuation and error messages."""

import dataclasses
import json

import numpy as np
import pytest

from gsim3d.cli.main import main
from gsim3d.errors import InputError
from gsim3d.synth import bound as module, generate
from gsim3d.synth.bound import ERRORS, GIVEN, StartErrors, bound, read_given
from gsim3d.synth.worlds import build_world

SMALL = {"image_size": 32, "n_frames": 7, "n_cams": 2, "n_trajectories": 2, "samples": 1, "objects": ("box", "spot")}
ONE = {"processes": 1, "progress": False}


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    root = tmp_path_factory.mktemp("sets")
    for world in ERRORS:
        generate(root / world, world, preset="published", **SMALL, **ONE)
    return root


@pytest.mark.parametrize("world", ERRORS)
def test_bound_without_errors_reproduces_the_set(sets, world, monkeypatch):
    monkeypatch.setitem(module.ERRORS, world, StartErrors(0.0))
    summary = bound(sets / world, **ONE)
    assert summary["n_scenes"] == 2 and summary["n_future_steps"] == SMALL["n_frames"] - GIVEN
    for kind in ("one", "mean"):
        for metric in ("psnr_masked", "psnr_body"):
            assert summary[kind][metric] == [100.0, 0.0] and summary["scenes"]["spot/0000"][kind][metric] == 100


@pytest.mark.parametrize("world", ERRORS)
def test_start_errors_have_their_lengths_at_the_last_given_step(world):
    """Positions differ by the error of position, and that of velocity for each step before or after."""
    settings = build_world(world, "published", {**SMALL, "drop_height": (0.9, 0.9), "fps": 42.0})
    drawn, errors = settings.draw("box", 0, 0), ERRORS[world]
    rng = np.random.default_rng(0)
    body = module._with_errors(drawn.bodies[0], errors, settings.fps, rng)
    _, (true, *_) = settings.simulate(drawn)
    _, (moved, *_) = settings.simulate(dataclasses.replace(drawn, bodies=[body]))
    shift = (moved - true).mean(1)
    last = GIVEN - 1
    np.testing.assert_allclose(np.linalg.norm(shift[last]), errors.place, atol=3e-5)
    np.testing.assert_allclose(np.linalg.norm(np.diff(shift, axis=0), axis=1)[1:], errors.velocity, rtol=0.03)

    def turned(step: int) -> float:
        a, b = (points[step] - points[step].mean(0) for points in (true, moved))
        u, _, v = np.linalg.svd(a.T @ b)
        return np.arccos((np.trace(u @ v) - 1) / 2)

    assert abs(turned(last) - errors.angle) < 1e-3
    spin = np.linalg.norm(drawn.bodies[0].body.spin)
    assert (spin > 0.1) == (world == "rigid")
    if world == "rigid":
        np.testing.assert_allclose(turned(6), errors.spin * spin * (6 - last) / settings.fps, rtol=0.2, atol=3e-5)


def test_bound_refuses_worlds_without_errors(tmp_path):
    generate(tmp_path, "push", **{**SMALL, "n_trajectories": 1}, **ONE)
    with pytest.raises(InputError, match="no bound for the world push; choose from elastic"):
        bound(tmp_path, **ONE)


def test_bound_summary_means_and_standard_errors():
    errors = np.full((module.SAMPLES + 1, 3, 2, 2), 1e-3)
    errors[-1] = 1e-4
    errors[:, 0, 0, 1] = np.nan  # an image without bodies
    scenes = {("a", 0): errors, ("a", 1): errors * 10, ("b", 0): errors}
    summary = module._summary(scenes, {"psnr_masked": 30.0})
    np.testing.assert_allclose(summary["one"]["psnr_masked"], [80 / 3, 10 / 3])
    np.testing.assert_allclose(summary["one"]["psnr_body"], [80 / 3, 10 / 3])
    np.testing.assert_allclose(summary["mean"]["psnr_masked"], [110 / 3, 10 / 3])
    expected = [-10 * np.log10(2e-3), -10 * np.log10(1.1e-2), -10 * np.log10(2e-3)]
    np.testing.assert_allclose(summary["one_given"]["psnr_masked"][0], np.mean(expected))
    assert "psnr_body" not in summary["one_given"] and summary["objects"]["b"]["mean"]["psnr_body"] == [40.0, None]
    np.testing.assert_allclose(summary["objects"]["a"]["one"]["psnr_masked"], [25.0, 5.0])
    assert summary["scenes"]["a/0001"]["one"]["psnr_masked"] == 20.0


def test_bound_command_continues_and_adds_given_errors(sets, tmp_path, capsys):
    scores = tmp_path / "metrics.json"
    scores.write_text(json.dumps({"past.psnr_masked": 30.0, "past.psnr_body": 22.0, "past.ssim": None}))
    arguments = ["bound", str(sets / "rigid"), "--out", str(tmp_path / "out"), "--processes", "1", "--quiet"]
    assert main([*arguments, "--trajectories", "1"]) == 0
    before = (tmp_path / "out" / "box-0000.npz").stat().st_mtime_ns
    assert main([*arguments, "--given", str(scores)]) == 0
    assert (tmp_path / "out" / "box-0000.npz").stat().st_mtime_ns == before
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[-3:]] == ["box", "spot", "all"] and "mean of 4 + given" in lines[-4]
    summary = json.loads((tmp_path / "out" / "bound.json").read_text())
    assert all(15 < summary[kind]["psnr_masked"][0] < 60 for kind in ("one", "mean"))
    assert summary["mean_given"]["psnr_masked"][0] < 30 and summary["mean_given"]["psnr_body"][0] < 22
    with pytest.raises(InputError, match="box-0000.npz is of another set"):
        bound(sets / "elastic", out=tmp_path / "out", **ONE)


def test_bound_refuses_other_sets(sets, tmp_path):
    with pytest.raises(InputError, match="manifest.json does not exist"):
        bound(tmp_path, **ONE)
    settings = json.loads((sets / "elastic" / "manifest.json").read_text())["settings"]
    for text in ("[]", "{", json.dumps({"settings": {**settings, "colour": 1}}), json.dumps({"settings": {}})):
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(InputError, match="manifest.json is not of a set"):
            bound(tmp_path, **ONE)
    (tmp_path / "manifest.json").write_text(json.dumps({"settings": settings}))
    with pytest.raises(InputError, match="0000 is not finished"):
        bound(tmp_path, **ONE)
    with pytest.raises(InputError, match="trajectories must be"):
        bound(sets / "elastic", trajectories=0, **ONE)
    (tmp_path / "short").mkdir()
    (tmp_path / "short" / "manifest.json").write_text(json.dumps({"settings": {**settings, "n_frames": GIVEN}}))
    with pytest.raises(InputError, match="4 frames; more than"):
        bound(tmp_path / "short", **ONE)
    for text in ("nan", "no-file.json", str(tmp_path / "manifest.json")):
        with pytest.raises(InputError, match="--given"):
            read_given(text)


def test_given_errors_are_those_of_reports_and_of_shipped_scores(tmp_path):
    scores = {"past.psnr_masked": 30.0, "past.psnr_body": 20.0}
    for content in (scores, {"held_out": scores, "name": "elastic-small"}):
        (tmp_path / "scores.json").write_text(json.dumps(content))
        assert read_given(str(tmp_path / "scores.json")) == {"psnr_masked": 30.0, "psnr_body": 20.0}
