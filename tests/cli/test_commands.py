"""The commands: help that teaches, one clear line and exit code 2 for bad input, nothing half written."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
import yaml

from gsim3d.cli.main import COMMANDS, main
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import CaptureError
from gsim3d.io import read_ply
from tests.conftest import cuda_problem
from tests.tiny_scenes import write_scene, write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

TRAINING = """
data: {history: 2, context_views: 2, target_only_cameras: [3], background_stride: 2}
phases:
  - {steps: 2, horizon: 1, target_views: 2}
"""


def call(capsys, *arguments):
    """(exit code, stdout, stderr) of a command run in this process."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as end:
        code = end.code
    output = capsys.readouterr()
    return code, output.out, output.err


@pytest.fixture(scope="module")
def work(tmp_path_factory, one_thread):
    """A data set, a training configuration, a trained run and a single-file export."""
    root = tmp_path_factory.mktemp("work")
    write_scenes(root / "data", 3)
    (root / "train.yaml").write_text(TRAINING)
    arguments = ["--data", root / "data", "--out", root / "run", "--export", root / "model.safetensors"]
    assert main(["train", *map(str, [root / "train.yaml", *arguments])]) == 0
    return root


@pytest.mark.parametrize("name", COMMANDS)
def test_help_teaches_with_examples(capsys, name):
    code, out, err = call(capsys, name, "--help")
    assert code == 0 and err == ""
    assert f"usage: gsim3d {name}" in out and "``" not in out
    assert name == "doctor" or re.search(rf"^\s*gsim3d {name} ", out, re.MULTILINE), "no example"


def test_overview_and_version(capsys):
    for arguments in ([], ["--help"]):
        code, out, _ = call(capsys, *arguments)
        assert code == 0 and all(re.search(rf"^  {name} ", out, re.MULTILINE) for name in COMMANDS)
    code, out, _ = call(capsys, "--version")
    assert code == 0 and re.fullmatch(r"gsim3d \d+\.\d+\.\d+\n", out)


def test_train_writes_checkpoint_log_and_export(capsys, work):
    assert (work / "run" / "checkpoints" / "last").read_text() == "step_000002"
    lines = (work / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [0, 1]
    code, out, _ = call(capsys, "train", work / "train.yaml", "--data", work / "data", "--out", work / "run")
    assert code == 0 and "resuming at step 2 of 2" in out


def test_train_with_decoded_files_learns_the_same(capsys, work, tmp_path):
    options = ["--data", work / "data", "--out", tmp_path / "run", "--cache", tmp_path / "cache"]
    assert call(capsys, "train", work / "train.yaml", *options)[0] == 0
    assert len(list((tmp_path / "cache").iterdir())) >= 2
    losses = [
        [json.loads(line)["loss"] for line in (run / "metrics.jsonl").read_text().splitlines()]
        for run in (work / "run", tmp_path / "run")
    ]
    assert len(losses[0]) == 2 and losses[0] == losses[1]


def test_printed_configuration_can_be_read_again(capsys, work, tmp_path):
    code, out, _ = call(capsys, "train", work / "train.yaml", "--print-config")
    assert code == 0 and yaml.safe_load(out)["data"]["target_only_cameras"] == [3]
    (tmp_path / "all.yaml").write_text(out)
    assert call(capsys, "train", tmp_path / "all.yaml", "--print-config")[1] == out


@pytest.mark.parametrize("checkpoint", ["run", "run/checkpoints/step_000002", "model.safetensors"])
def test_evaluate_prints_a_table_and_writes_json(capsys, work, tmp_path, checkpoint):
    out_file = tmp_path / "metrics.json"
    code, out, _ = call(capsys, "evaluate", work / checkpoint, work / "data", "--steps", "3", "--out", out_file)
    assert code == 0 and "PSNR masked" in out and "SSIM" in out and "4 predicted" in out
    metrics = json.loads(out_file.read_text())
    assert metrics["n_scenes"] == 1 and metrics["n_future_steps"] == 3
    for key in ("future.psnr", "future.psnr_masked", "future.ssim", "constant.future.psnr", "copy.future_late.ssim"):
        assert isinstance(metrics[key], float), key


def test_evaluate_counts_scenes(capsys, work):
    code, out, _ = call(capsys, "evaluate", work / "run", work / "data", "--scenes", "train", "--steps", "1")
    assert code == 0 and "2 scenes" in out and (work / "run" / "metrics.json").is_file()


def test_evaluate_takes_other_views_and_metrics_and_options_anywhere(capsys, work, tmp_path):
    arguments = [work / "run", "--out", tmp_path / "m.json", work / "data", "--steps", "2", "--metrics", "ssim", "psnr"]
    code, out, _ = call(capsys, "evaluate", *arguments, "--cameras", "1", "4", "--context", "0", "2")
    assert code == 0 and "masked:" in out and "PSNR masked" not in out
    metrics = json.loads((tmp_path / "m.json").read_text())
    assert metrics["cameras"] == {"ball/0000": {"context": [0, 2], "target": [1, 4]}}
    assert metrics["part"] == "test" and metrics["data"] == str(work / "data") and len(metrics["checkpoint"]) == 64
    assert metrics["effects"] == EffectsSpec().hash
    assert metrics["methods"] == ["model", "constant", "copy", "constant_velocity", "release_constant"]
    assert list(metrics["by_step"])[:2] == ["psnr", "ssim"] and metrics["not_measured"] == {}
    for file in ("m.csv", "m.md", "m.png"):
        assert (tmp_path / file).stat().st_size > 100


def test_both_devices_predict(capsys, work, tmp_path, device):
    evaluate = [
        "evaluate",
        work / "run",
        work / "data",
        "--steps",
        "2",
        "--metrics",
        "psnr",
        "--out",
        tmp_path / "m.json",
    ]
    assert call(capsys, *evaluate, "--device", device)[0] == 0
    simulate = ["simulate", work / "run", work / "data" / "ball" / "0000", "--out", tmp_path / "out", "--steps", "1"]
    assert call(capsys, *simulate, "--device", device)[0] == 0
    assert read_ply(tmp_path / "out" / "gaussians" / "step_0002.ply").means.isfinite().all()


@pytest.mark.skipif(cuda_problem() is None, reason="there is a GPU that gsim3d can use")
def test_a_gpu_that_is_not_there_is_named(capsys, work):
    code, _, err = call(capsys, "evaluate", work / "run", work / "data", "--device", "cuda")
    assert code == 2 and "device cuda: " in err and len(err.splitlines()) == 1


def test_simulate_writes_video_frames_and_gaussians(capsys, work, tmp_path):
    scene, out = work / "data" / "ball" / "0000", tmp_path / "out"
    chosen = ("--steps", "7", "--cameras", "3", "1", "--html")
    code, _, _ = call(capsys, "simulate", work / "run", scene, "--out", out, *chosen)
    assert code == 0
    page = (out / "player.html").read_text()
    assert '"start": 2' in page and '"viewmat"' in page and "<canvas" in page
    assert any(codec in (out / "rollout.mp4").read_bytes() for codec in (b"avc1", b"vp09"))
    assert len(list((out / "frames").iterdir())) == 2 * 9
    files = sorted((out / "gaussians").glob("*.ply"))
    assert [file.name for file in files] == [f"step_{step:04d}.ply" for step in range(9)]
    assert read_ply(files[2]).means.shape == read_ply(files[8]).means.shape
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def broken_scene(work, tmp_path, name):
    scene = tmp_path / "scene"
    shutil.copytree(work / "data" / "ball" / "0000", scene)
    if name == "image":
        (scene / "cam_0" / "rgb_0001.png").write_bytes(b"no image")
    elif name == "missing image":
        (scene / "cam_0" / "rgb_0000.png").unlink()
    elif name == "metadata":
        (scene / "metadata.json").write_text("{")
    return scene


BAD = {
    "unknown command": (["trian"], "unknown command 'trian'"),
    "unknown option": (["train", "--speed", "9"], "unrecognized arguments: --speed"),
    "no configuration": (["train", "--data", "{data}", "--out", "{new}"], "CONFIG is required"),
    "configuration is missing": (["train", "no.yaml", "--data", "{data}", "--out", "{new}"], "no.yaml cannot be read"),
    "data is missing": (["train", "{config}", "--data", "{new}/data", "--out", "{new}"], "data"),
    "no scene": (["train", "{config}", "--data", "{empty}", "--out", "{new}"], "contains no scene"),
    "bad step": (["train", "{config}", "--data", "{data}", "--out", "{new}", "--until", "0"], "--until"),
    "bad export": (["train", "{config}", "--data", "{data}", "--out", "{new}", "--export", "a.pt"], "--export"),
    "out is a file": (["train", "{config}", "--data", "{data}", "--out", "{config}"], "is not a folder"),
    "no checkpoint": (["evaluate", "{empty}", "{data}"], "not a checkpoint"),
    "checkpoint is missing": (["evaluate", "{new}", "{data}"], "no such checkpoint"),
    "checkpoint is another file": (["evaluate", "{config}", "{data}"], "not a gsim3d checkpoint"),
    "out is in a file": (["evaluate", "{run}", "{data}", "--out", "{config}/a/b.json"], "train.yaml, which is no"),
    "too many steps": (["evaluate", "{run}", "{data}", "--steps", "99"], "only 4 after the input"),
    "bad choice": (["evaluate", "{run}", "{data}", "--scenes", "some"], "invalid choice: 'some'"),
    "no such view": (["evaluate", "{run}", "{data}", "--cameras", "9"], "camera 9 does not exist"),
    "no such input view": (["evaluate", "{run}", "{data}", "--context", "7"], "camera 7 does not exist"),
    "out exists": (["simulate", "{run}", "{scene}", "--out", "{empty}"], "exists already"),
    "folder of scenes": (["simulate", "{run}", "{data}", "--out", "{new}"], "such as {data}/ball/0000"),
    "scene is missing": (["simulate", "{run}", "{new}/scene", "--out", "{new}"], "is not a folder"),
    "no such camera": (["simulate", "{run}", "{scene}", "--out", "{new}", "--cameras", "9"], "camera 9 does not exist"),
    "no such context camera": (["simulate", "{run}", "{scene}", "--out", "{new}", "--context", "-1"], "at least 0"),
    "no step": (["simulate", "{run}", "{scene}", "--out", "{new}", "--steps", "0"], "at least 1"),
    "start too late": (["simulate", "{run}", "{scene}", "--out", "{new}", "--start", "5"], "needs 2 steps from step 5"),
    "not a number": (["simulate", "{run}", "{scene}", "--out", "{new}", "--steps", "many"], "invalid int value"),
    "no out": (["simulate", "{run}", "{scene}"], "required: --out"),
    "broken metadata": (["simulate", "{run}", "{metadata}", "--out", "{new}"], "metadata.json cannot be read"),
    "broken image": (["simulate", "{run}", "{image}", "--out", "{new}"], "cannot be decoded"),
    "missing image": (["simulate", "{run}", "{missing image}", "--out", "{new}"], "is missing"),
    "other image size": (["simulate", "{run}", "{large}", "--out", "{new}"], "images of 48x48 pixels"),
    "demo needs a folder": (["demo", "--out", "{config}"], "is not a folder"),
    "too few steps": (["train", "{long}", "--data", "{data}", "--out", "{new}"], "100 steps do not fit: lower"),
    "unknown world": (["generate", "lava", "--out", "{new}"], "lava"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_line_and_exit_code_2(capsys, work, tmp_path, name):
    arguments, message = BAD[name]
    empty = tmp_path / "empty"
    empty.mkdir()
    places = {
        "data": work / "data", "config": work / "train.yaml", "run": work / "run", "scene": work / "data/ball/0000",
        "empty": empty, "new": tmp_path / "new", "long": tmp_path / "long.yaml",
    }  # fmt: skip
    places["long"].write_text(TRAINING.replace("history: 2", "history: 99"))
    words = set(re.findall(r"{([\w ]+)}", " ".join(arguments)))
    for broken in words & {"image", "missing image", "metadata"}:
        places[broken] = broken_scene(work, tmp_path, broken)
    if "large" in words:
        places["large"] = write_scene(tmp_path / "large", size=48)
    before = sorted(tmp_path.rglob("*"))
    code, _, err = call(capsys, *(argument.format(**places) for argument in arguments))
    lines = [line for line in err.splitlines() if line.startswith("gsim3d: error: ")]
    assert code == 2, err
    assert len(lines) == 1 and message.format(**places) in lines[0], err
    assert "Traceback" not in err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_wrong_setting_is_named(capsys, work, tmp_path):
    (tmp_path / "bad.yaml").write_text("optimizer: {learning_rte: 1}\n")
    code, _, err = call(capsys, "train", tmp_path / "bad.yaml", "--data", work / "data", "--out", tmp_path / "run")
    assert code == 2 and err.startswith(f"gsim3d: error: {tmp_path / 'bad.yaml'}: optimizer.learning_rte: unknown")
    assert not (tmp_path / "run").exists()


def test_out_of_memory_is_one_line(capsys, work, tmp_path, monkeypatch):
    def full(*args, **options):
        raise CaptureError("captured: no room;\nlower batch", out_of_memory=True)

    monkeypatch.setattr("gsim3d.train.loop.Trainer.run", full)
    (tmp_path / "config.yaml").write_text(TRAINING)
    code, _, err = call(capsys, "train", tmp_path / "config.yaml", "--data", work / "data", "--out", tmp_path / "run")
    assert (code, err) == (2, "gsim3d: error: captured: no room; lower batch\n")


def test_weights_of_another_model_are_refused(capsys, work, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(work / "run", run)
    folder = run / "checkpoints" / "step_000002"
    state = json.loads((folder / "state.json").read_text())
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["model"]["dynamics"]["mlp_ratio"] = 3
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    code, _, err = call(capsys, "evaluate", run, work / "data")
    assert code == 2 and "config.yaml: missing, truncated or changed" in err
    from gsim3d.io.checkpoint import OWN_HASH, hash_of_state
    from gsim3d.io.files import sha256_of

    state.pop(OWN_HASH)
    state["sha256"]["config.yaml"] = sha256_of(folder / "config.yaml")
    (folder / "state.json").write_text(json.dumps({**state, OWN_HASH: hash_of_state(state)}))
    code, _, err = call(capsys, "evaluate", run, work / "data")
    assert code == 2 and "the weights do not fit the model" in err and len(err.splitlines()) == 1


def test_as_a_program():
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    command = [sys.executable, "-m", "gsim3d", "evaluate", "nowhere", "nothing"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("gsim3d: error: nowhere: no such checkpoint") and done.stderr.count("\n") == 1
