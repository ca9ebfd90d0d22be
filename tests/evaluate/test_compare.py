"""Paired comparison of two reports: by hand, and what is refused."""

import copy
import json
import math

import pytest

from gsim3d.cli.main import main
from gsim3d.errors import InputError
from gsim3d.evaluate.compare import compare, read_report, table


def report(values, ssim=None, method="model", **more):
    """A report of scenes a, b, ... with these future.psnr."""
    prefix = "" if method == "model" else f"{method}."
    scenes = {
        name: {"digest": f"digest {name}", f"{prefix}future.psnr": value, **({"future.ssim": ssim} if ssim else {})}
        for name, value in zip("abcdefgh", values)
    }
    steps = {"n_encoded_steps": 4, "n_future_steps": 80}
    return {"checkpoint": "0" * 64, "methods": [method, "copy"], **steps, "scenes": scenes, **more}


def test_differences_and_errors_by_hand():
    found = compare(report([21.0, 23.0, 25.0]), report([20.0, 20.0, 20.0]), "b.json")[""]["future.psnr"]
    assert found["difference"] == 3 and found["scenes"] == 3
    assert found["standard_error"] == pytest.approx(2 / math.sqrt(3)) and found["verdict"] == "better"
    text = table(compare(report([21.0, 23.0, 25.0]), report([20.0, 20.0, 20.0]), "b.json"), "b.json")
    assert "+3.00 ± 1.15" in text and "3 scenes: better" in text


@pytest.mark.parametrize(
    "ours, verdict",
    [
        ([21.0, 21.0, 21.1], "better"),
        ([19.0, 19.0, 19.1], "worse"),
        ([21.0, 19.0, 20.9], "equal within two standard errors"),
        ([20.0, 20.0, 20.0], "equal within two standard errors"),
        ([21.9, 20.1, 21.0], "equal within two standard errors"),  # 1.9 standard errors
        ([21.0], "single scene: no standard error"),
    ],
)
def test_verdict_needs_two_standard_errors(ours, verdict):
    other = [20.0] * len(ours)
    found = compare(report(ours), report(other), "b.json")
    assert found[""]["future.psnr"]["verdict"] == verdict
    assert ("better" in table(found, "b.json")) == (verdict == "better")


def test_standard_error_is_of_pairs():
    scenes = [10.0, 20.0, 30.0, 40.0]
    ours = [value + gain for value, gain in zip(scenes, (0.9, 1.0, 1.1, 1.0))]
    assert compare(report(ours), report(scenes), "b")[""]["future.psnr"]["verdict"] == "better"


def test_lower_is_better_where_it_is_and_scenes_without_a_value_are_left_out():
    ours, other = report([1.0, 1.0, None]), report([1.0, 1.0, 9.0])
    for scores, values in ((ours, (0.1, 0.12, 0.11)), (other, (0.2, 0.2, 0.2))):
        for scene, value in zip(scores["scenes"].values(), values):
            scene["future.lpips_vgg"] = value
    found = compare(ours, other, "b")[""]
    assert found["future.lpips_vgg"]["verdict"] == "better" and found["future.psnr"]["scenes"] == 2


def test_predictions_of_other_models_are_compared_under_their_first_name():
    found = compare(report([2.0, 2.0], method="video"), report([1.0, 1.0]), "b")
    assert found[""]["future.psnr"]["difference"] == 1


def without_digest(other):
    del other["scenes"]["a"]["digest"]


def other_clip(other):
    other["scenes"]["b"]["digest"] = "another"


def fewer_scenes(other):
    del other["scenes"]["b"]


def more_scenes(other):
    other["scenes"]["z"] = {}


def other_steps(other):
    other["n_future_steps"] = 28


def other_history(other):
    other["n_encoded_steps"] = 2


@pytest.mark.parametrize(
    "damage, message",
    [
        (without_digest, "b.json: has no digest of the scored images of a"),
        (other_clip, "b.json: images, labels or target cameras of b differ"),
        (fewer_scenes, r"b.json: different scenes: b is not scored there \(1 scenes differ\)"),
        (more_scenes, "b.json: different scenes: z is scored only there"),
        (other_steps, "b.json: 28 predicted steps, here 80"),
        (other_history, "b.json: 2 given steps, here 4"),
    ],
)
def test_other_scenes_are_refused(damage, message):
    other = report([1.0, 2.0])
    damage(other)
    with pytest.raises(InputError, match=message):
        compare(report([1.0, 2.0]), other, "b.json")


def write(path, content):
    path.write_text(json.dumps(content))
    return str(path)


def test_the_command_compares_two_files_and_the_sets_of_shipped_scores(tmp_path, capsys):
    ours, other = report([3.0, 3.1, 3.0]), report([1.0, 1.0, 1.0])
    files = write(tmp_path / "a.json", ours), write(tmp_path / "b.json", other)
    assert main(["evaluate", files[0], "--against", files[1]]) == 0
    assert "3 scenes: better" in capsys.readouterr().out
    sets = {"name": "elastic-small", "held_out": ours, "unseen": copy.deepcopy(ours)}
    files = write(tmp_path / "a.json", sets), write(tmp_path / "b.json", {"held_out": other, "raised": other})
    assert list(compare(read_report(files[0]), read_report(files[1]), "b")) == ["held_out"]
    cases = {None: {"unseen": other}, "no set in common": {"raised": other}, "JSON object": [], "not a report": {}}
    for message, broken in cases.items():
        file = write(tmp_path / "c.json", broken)
        code = main(["evaluate", files[0], "--against", file])
        err = capsys.readouterr().err
        assert (code == 0) == (message is None) and (message or "") in err and len(err.splitlines()) <= 1
    assert main(["evaluate", files[0]]) == 2 and "nothing to evaluate" in capsys.readouterr().err
