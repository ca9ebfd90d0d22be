"""tools/slurm and tools/bench/training.py: what can be known without a cluster and a GPU."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsim3d import presets
from gsim3d.simulator import Simulator
from gsim3d.state import last_steps

ROOT = Path(__file__).parents[2]


def test_the_slurm_script_starts_torchrun_on_every_node(tmp_path):
    for name, text in {"scontrol": "echo node-7; echo node-8", "srun": 'echo "$OMP_NUM_THREADS threads: $*"'}.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    slurm = {"JOB_ID": "41", "JOB_NODELIST": "node-[7-8]", "NNODES": "2", "GPUS_ON_NODE": "4", "CPUS_PER_TASK": "16"}
    environment = {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        **{f"SLURM_{name}": value for name, value in slurm.items()},
    }
    command = ["bash", str(ROOT / "tools/slurm/train.sbatch")]
    given = ["a b.yaml", "--data", "d", "--out", "o"]
    done = subprocess.run([*command, *given], env=environment, capture_output=True, text=True, check=True)
    threads, _, words = done.stdout.strip().partition(" threads: ")
    launcher, _, ours = words.partition(" -m gsim3d ")
    assert threads == "4" and ours == "train a b.yaml --data d --out o --device cuda"
    assert "torchrun --nnodes 2 --nproc-per-node 4" in launcher and "--rdzv-endpoint node-7:20041" in launcher
    known = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--help"], capture_output=True, text=True
    ).stdout
    options = [word for word in launcher.partition("torchrun ")[2].split() if word.startswith("--")]
    assert len(options) == 6 and all(option in known.replace("_", "-") for option in options)
    assert subprocess.run(command, env=environment, capture_output=True).returncode == 2


@pytest.fixture
def bench(monkeypatch):
    """The module tools/bench/training.py."""
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "bench"))
    spec = importlib.util.spec_from_file_location("bench_training", ROOT / "tools" / "bench" / "training.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("masked", [True, False])
def test_synthetic_batches_have_their_true_size(masked, bench):
    batch, places = bench.synthetic_batch(2, 32, masked)
    assert (batch.n_context, batch.n_future) == (4, 12)
    assert batch.context.images.shape == (2 * 4 * 4, 3, 32, 32)
    assert batch.targets.images.shape == (2 * 16 * 5, 3, 32, 32)
    assert batch.context.cloud_scene.tolist() == [0] * 4 + [1] * 4
    assert batch.targets.cameras.image_cloud.unique().numel() == 2 * 16
    assert not batch.context.images[0].equal(batch.context.images[4 * 3])  # the body sinks
    context = batch.context
    assert 0.2 < context.dynamic.float().mean() < 0.3
    assert places.shape == ((int(context.dynamic.sum()) if masked else 2 * 16 * 32 * 32), 3)
    assert (context.masks is None) == (not masked) and (not masked or context.masks.equal(context.dynamic))


def test_benchmark_images_show_their_particles(bench):
    """A pixel's place projects into its middle, and lies on the body or on the ground."""
    scene, size = bench.surface_scene, 32
    _, body, places = scene.clip(2, size)
    viewmats = scene.poses().float()[:, None, None]
    seen = (viewmats[..., :3, :3] @ places[..., None])[..., 0] + viewmats[..., :3, 3]
    pixels = (scene.intrinsics(size).float() @ (seen / seen[..., 2:])[..., None])[..., 0]
    middle = torch.stack(torch.meshgrid(*[torch.arange(size) + 0.5] * 2, indexing="xy"), -1)
    assert (pixels[..., :2] - middle).abs().max() < 1e-3
    assert places[~body][:, 2].abs().max() < 1e-5 and places[~body][:, :2].norm(dim=-1).max() < scene.DISC_RADIUS
    center = torch.tensor([0, 0, scene.FIRST_HEIGHT - 2 * scene.FALL])
    radii = ((places[body] - center) / torch.tensor(scene.HALF_AXES)).norm(dim=-1)
    assert (radii - 1).abs().max() < 1e-4
    assert scene.NEAR < seen[..., 2].min() and seen[..., 2].max() < scene.FAR


def test_particles_of_the_benchmark_sink_with_the_body(bench, tmp_path):
    """Encoded particles lie where the video shows the body, and simulated ones move as it does, within a millimetre."""
    scene, config = bench.surface_scene, presets.tiny()
    torch.manual_seed(0)
    simulator = Simulator(config).eval()
    frames, places = scene.frames(1, [scene.evenly(2)] * 2, 32, masked=True)
    scene.as_if_trained(simulator, places)
    with torch.no_grad():
        state = simulator.encode(frames)
        steps = simulator.rollout(state, 2)
    assert state.means.equal(places)
    moved = steps[1].means - last_steps(state, 1).means
    assert (moved - torch.tensor([0, 0, -2 * scene.FALL])).abs().max() < 1e-3
    scales = simulator.renderer(steps[1]).scales
    assert (scales / scene.WIDTH - 1).abs().max() < 0.05


@pytest.mark.parametrize("masked", [True, False])
def test_padding_particles_of_benchmark_stay(masked, bench):
    """A captured step has as many rows for every cloud, more than there are particles."""
    scene = bench.surface_scene
    torch.manual_seed(0)
    simulator = Simulator(presets.tiny()).eval()
    frames, places = scene.frames(1, [scene.evenly(2)] * 2, 32, masked)
    counts = [len(places) // 2] * 2
    if masked:
        frames.masks[0, :, :16] = False  # clouds of different sizes
        counts = frames.masks.reshape(2, -1).sum(1).tolist()
        places = scene.frames(1, [scene.evenly(2)] * 2, 32, False)[1][frames.masks.flatten()]
        assert counts[0] < counts[1]
    shapes = simulator.encoder.static_shapes(frames, max(counts) + 5)
    with torch.no_grad():
        before = simulator.encode(frames, shapes=shapes)
        state = scene.as_if_trained(simulator, places).encode(frames, shapes=shapes)
    for q, (begin, end) in enumerate(state.cu_rows.unfold(0, 2, 1).tolist()):
        middle = begin + counts[q]
        assert end - begin == max(counts) + 5
        assert state.means[begin:middle].equal(places.split(counts)[q])
        assert state.means[middle:end].equal(before.means[middle:end])


@pytest.mark.parametrize("error, is_failed", [(RuntimeError("broken"), True), (torch.cuda.OutOfMemoryError(), False)])
def test_failed_benchmark_case_leaves_the_others(error, is_failed, bench, monkeypatch, tmp_path, capsys):
    def measure(name, args, processes):
        if name == "captured":
            raise error
        row = {"case": name, "processes": 1, "batch": 1, "particles": 7, "seconds": 1.0, "gib": 1.0, "loss": 0.5}
        return row

    file = tmp_path / "rows.json"
    monkeypatch.setattr(bench, "measure", measure)
    monkeypatch.setattr(sys, "argv", ["training.py", "--json", str(file), "--case", "kept", "captured", "blocks"])
    if is_failed:
        with pytest.raises(SystemExit, match="training: captured failed"):
            bench.main()
        assert "broken" in capsys.readouterr().err
    else:
        bench.main()
        assert "captured     out of memory" in capsys.readouterr().out
    assert [row["case"] for row in json.loads(file.read_text())] == ["kept", "blocks"]


def test_rows_of_other_benchmark_cases_stay(bench, tmp_path):
    file = tmp_path / "rows.json"
    bench.keep_rows(file, [{"case": "a", "processes": 1, "seconds": 1}, {"case": "a", "processes": 2, "seconds": 2}])
    bench.keep_rows(file, [{"case": "a", "processes": 2, "seconds": 3}])
    assert [row["seconds"] for row in json.loads(file.read_text())] == [1, 3]


def test_page_shows_measured_training_steps(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "bench"))
    report = importlib.import_module("report")
    row = {"case": "kept", "processes": 1, "batch": 4, "particles": 17000, "seconds": 0.876, "gib": 61.25}
    row |= {"efficiency": None, "gpu": "a GPU", "torch": "2.11", "commit": "abc", "date": "2026-11-21"}
    text = report.steps_table([{**row, "processes": 2, "efficiency": 0.934}, row])
    assert "| kept | 1 | 4 | 17000 | 0.88 | 61.2 | - |\n| kept | 2 | 4 | 17000 | 0.88 | 61.2 | 93% |\n" in text
