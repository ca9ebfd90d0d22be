"""What is held out: our rule leaks nothing and does not ask the file system; the published rule is there to compare."""

import pytest

from gsim3d.cli.main import main
from gsim3d.data import find_scenes, published_split, split_scenes
from tests.tiny_scenes import write_scene


@pytest.mark.parametrize("n", [2, 3, 14, 15, 60, 125, 126, 1200])
def test_our_rule_never_trains_on_what_it_tests(n):
    train, test = split_scenes(range(n))
    assert not set(train) & set(test) and sorted(train + test) == list(range(n)) and test


def test_published_rule():
    train, test = published_split(range(1200))
    assert test == list(range(0, 1200, 8)) and len(test) == 150 and len(train) == 1050 and not set(train) & set(test)
    # int(0.12 * 130) = 15 scenes are every 8th of 130, which makes 17; of 100 they are every 8th, 13: fewer than 15,
    # so all are trained on as well.
    assert [len(part) for part in published_split(range(130))] == [113, 17]
    assert [len(part) for part in published_split(range(100))] == [100, 13]
    assert published_split(range(10)) == (list(range(10)), [0])


def test_scenes_come_in_natural_order_whatever_the_file_system_says(tmp_path, monkeypatch):
    names = ["10", "9", "2", "1"]
    for name in names:
        (tmp_path / "ball" / name).mkdir(parents=True)
        (tmp_path / "ball" / name / "metadata.json").write_text("{}")
    listed = type(tmp_path).iterdir
    for order in (lambda path: path.name, lambda path: -int(path.name) if path.name.isdigit() else 0):
        monkeypatch.setattr(type(tmp_path), "iterdir", lambda self: iter(sorted(listed(self), key=order)))
        assert [path.name for path in find_scenes(tmp_path)] == ["1", "2", "9", "10"]


def test_the_command_takes_either_rule(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path / "cache"))
    for i in range(3):
        folder = write_scene(tmp_path / "data" / f"{i}", n_steps=3, seed=i)
        for labels in folder.glob("*/seg_*.png"):
            labels.unlink()  # each scene is its own prediction: what is left are frames whose names end in the step
    command = ["evaluate", "--predictions", f"same={tmp_path / 'data'}", str(tmp_path / "data"), "--given", "1"]
    command += ["--out", str(tmp_path / "m.json"), "--metrics", "ssim", "--scenes", "train"]
    for rule, count in (("gsim3d", 2), ("published", 3)):
        assert main([*command, "--split", rule]) == 0
        assert f"{count} scenes, 1 steps given, 2 predicted" in capsys.readouterr().out
