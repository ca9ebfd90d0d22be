"""Several processes score scenes together: the files of one process, byte for byte."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gsim3d.cli.main import main
from gsim3d.data import Scene
from gsim3d.evaluate import protocol
from gsim3d.train.processes import Processes
from gsim3d.train.restore import restore
from tests.evaluate.test_frame_rate import untrained
from tests.tiny_scenes import write_scenes
from tests.two_processes import run_in_two_processes

pytestmark = pytest.mark.usefixtures("one_thread")

N_SCENES = 3
OPTIONS = ("--scenes", "all", "--metrics", "psnr", "psnr_masked", "psnr_ring", "ssim")


@pytest.fixture(scope="module")
def place(tmp_path_factory, one_thread):
    """Three scenes and a model."""
    root = tmp_path_factory.mktemp("shared")
    data = write_scenes(root / "data", N_SCENES, n_steps=4)
    untrained(root / "model.safetensors", Scene.open(data / "ball" / "0000"))
    return root


def evaluate(root, out):
    return main(["evaluate", str(root / "model.safetensors"), str(root / "data"), *OPTIONS, "--out", str(out)])


def evaluate_together(rank: int, root: str) -> None:
    """What each of two processes does where a scene of the second one is broken."""
    assert evaluate(Path(root), Path(root) / "two.json") == 2


def test_both_processes_end_where_one_cannot_read_a_scene(place, tmp_path):
    shutil.copytree(place, tmp_path / "copy")
    (tmp_path / "copy" / "data" / "ball" / "0001" / "cam_3" / "rgb_0002.png").write_bytes(b"no image")
    run_in_two_processes(evaluate_together, tmp_path / "copy")
    assert not list((tmp_path / "copy").glob("two.*"))


def test_two_processes_write_the_files_of_one(place):
    """Also where torchrun gives each of them one thread, and the one has several."""
    runs = {"one": ("3", ()), "two": ("1", ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"))}
    for name, (n_threads, launcher) in runs.items():
        command = [sys.executable, *launcher, "-m", "gsim3d", "evaluate", str(place / "model.safetensors")]
        command += [str(place / "data"), *OPTIONS, "--out", str(place / f"{name}.json")]
        environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": n_threads}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert done.stdout.count("written: ") == 1
    for ending in ("json", "csv", "md"):
        assert (place / f"two.{ending}").read_bytes() == (place / f"one.{ending}").read_bytes(), ending
    assert list(json.loads((place / "two.json").read_text())["scenes"]) == [f"ball/000{n}" for n in range(N_SCENES)]


def test_batches_do_not_depend_on_the_processes(place, monkeypatch):
    """What a GPU does: scenes of a batch are predicted together; the batches are dealt over the processes."""
    restored = restore(place / "model.safetensors")
    scenes = [restored.open_scene(place / "data" / "ball" / f"{n:04d}") for n in range(N_SCENES)]
    views = [protocol.default_views(restored, scene) for scene in scenes]
    assert protocol._batches(restored, scenes, [context for context, _ in views]) == [[0], [1], [2]]  # on a CPU
    monkeypatch.setattr(protocol, "_batches", lambda *_: [[0, 2], [1]])
    given = {"n_encoded": 2, "n_future": 2, "metrics": ("psnr",)}
    whole = protocol.score_scenes(restored, scenes, views, **given)
    dealt = []

    class Second(Processes):
        def gather(self, value):
            dealt.append([number for number, _ in value])
            return [[(number, whole[number]) for number in (0, 2)], value]

    again = protocol.score_scenes(restored, scenes, views, **given, processes=Second(1, 2))
    assert dealt == [[1]]
    for scene, ours, theirs in zip(scenes, whole, again, strict=True):
        assert (ours.scene, ours.digest) == (theirs.scene, theirs.digest)
        alone = protocol.score_scene(restored, scene, n_future=2)
        psnrs = [scores.values["model"]["psnr"].tolist() for scores in (ours, theirs, alone)]
        assert psnrs[0] == psnrs[1] == pytest.approx(psnrs[2], abs=1e-3)


def test_fvd_is_of_a_given_number_of_clips(place, monkeypatch):
    restored = restore(place / "model.safetensors")
    scenes = [restored.open_scene(place / "data" / "ball" / f"{n:04d}") for n in range(N_SCENES)]
    views = [(context, (3, 1)) for context, _ in (protocol.default_views(restored, scene) for scene in scenes)]
    asked = []
    monkeypatch.setattr(
        protocol, "score_scene", lambda _, scene, metrics, **more: asked.append("fvd" in metrics) or scene.name
    )
    given = {"n_encoded": 2, "n_future": 2, "metrics": ("psnr", "fvd")}
    for clips, expected in ((48, [True] * 3), (5, [True, True, False]), (2, [True, False, False])):
        asked.clear()
        protocol.score_scenes(restored, scenes, views, **given, clips=clips)
        assert asked == expected
