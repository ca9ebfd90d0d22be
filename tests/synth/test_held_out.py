"""Held-out sets: recognition, default scores, and exclusion from training."""

import json

import pytest

from gsim3d.cli.main import main
from gsim3d.synth.held_out import SETS, describe_set, origin_of, set_of
from gsim3d.synth.worlds import TEST_SEED, VALIDATION_SEED
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")


def generated(root, count, seed, **changes):
    """Scenes that say, as those of `gsim3d generate` do, where they are from."""
    write_scenes(root, count, n_steps=3)
    folders = sorted((root / "ball").iterdir())
    for number, folder in enumerate(folders):
        metadata = json.loads((folder / "metadata.json").read_text())
        says = {"world": "elastic", "subset": "train", "seed": seed, "object": f"body {number % 2}", **changes}
        (folder / "metadata.json").write_text(json.dumps({**metadata, **says}))
    return folders


def test_held_out_seeds_are_unique():
    assert SETS == {"validation": (VALIDATION_SEED, 24), "test": (TEST_SEED, 56)} and VALIDATION_SEED != TEST_SEED


def test_set_of_generated_scenes(tmp_path):
    folders = generated(tmp_path / "a", 4, VALIDATION_SEED)
    found = set_of(folders)
    assert found["name"] == "validation" and found["subset"] is None and found["bodies"] == {"body 0": 2, "body 1": 2}
    assert describe_set(found) == (
        "Validation set: 4 trajectories of elastic with seed 77, 2 a body; the whole set has 24."
    )
    unseen = set_of(generated(tmp_path / "b", 3, TEST_SEED, subset="unseen"))
    assert describe_set(unseen) == "Test set: 3 trajectories of elastic (unseen) with seed 78, 1 to 2 a body."
    other = set_of(generated(tmp_path / "c", 2, 5))
    assert describe_set(other).startswith("Neither the validation nor the test set: 2 trajectories of elastic")
    assert set_of([*folders, *sorted((tmp_path / "c" / "ball").iterdir())]) is None and set_of([]) is None


@pytest.mark.parametrize("says", ["{}", "[]", "no JSON", '{"world": ["a"], "seed": 77}', '{"world": "x", "seed": 77}'])
def test_set_of_other_scenes_is_none(tmp_path, says):
    (tmp_path / "metadata.json").write_text(says)
    assert origin_of(tmp_path) is None and set_of([tmp_path]) is None and origin_of(tmp_path / "absent") is None


@pytest.mark.parametrize("seed, part, count", [(VALIDATION_SEED, "all", 3), (TEST_SEED, "all", 3), (5, "test", 1)])
def test_held_out_sets_are_scored_as_a_whole(tmp_path, capsys, seed, part, count):
    folders = generated(tmp_path / "data", 3, seed)
    for folder in folders:
        for labels in folder.glob("*/seg_*.png"):
            labels.unlink()  # each scene is its own prediction: what is left are frames whose names end in the step
    command = ["evaluate", "--predictions", f"same={tmp_path / 'data'}", str(tmp_path / "data"), "--given", "1"]
    assert main([*command, "--metrics", "psnr", "--out", str(tmp_path / "m.json")]) == 0
    report = json.loads((tmp_path / "m.json").read_text())
    assert (report["part"], report["n_scenes"], report["set"]["seed"]) == (part, count, seed)
    assert describe_set(report["set"]) in capsys.readouterr().out


@pytest.mark.parametrize("seed", [VALIDATION_SEED, TEST_SEED])
def test_training_leaves_held_out_sets_out(tmp_path, capsys, seed):
    generated(tmp_path / "data", 3, seed)
    (tmp_path / "train.yaml").write_text("preset: tiny\n")
    command = ["train", str(tmp_path / "train.yaml"), "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")]
    assert main(command) == 2
    assert f"(seed {seed}), which is held out" in capsys.readouterr().err
