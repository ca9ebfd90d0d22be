"""tools/slurm and tools/bench/training.py: what can be known without a cluster and a GPU."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

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
    assert "torchrun --nnodes 2 --nproc-per-node 4" in launcher and launcher.endswith("--rdzv-endpoint node-7:20041")
    known = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--help"], capture_output=True, text=True
    ).stdout
    options = [word for word in launcher.partition("torchrun ")[2].split() if word.startswith("--")]
    assert len(options) == 5 and all(option in known.replace("_", "-") for option in options)
    assert subprocess.run(command, env=environment, capture_output=True).returncode == 2


@pytest.mark.parametrize("masked", [True, False])
def test_synthetic_batches_have_their_true_size(masked, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "bench"))
    spec = importlib.util.spec_from_file_location("bench_training", ROOT / "tools" / "bench" / "training.py")
    bench = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, bench)
    spec.loader.exec_module(bench)
    batch = bench.synthetic_batch(2, 32, masked)
    assert (batch.n_context, batch.n_future) == (4, 12)
    assert batch.context.images.shape == (2 * 4 * 4, 3, 32, 32) and batch.targets.images.shape == (
        2 * 16 * 5,
        3,
        32,
        32,
    )
    assert batch.context.cloud_scene.tolist() == [0] * 4 + [1] * 4 and batch.target_step().unique().numel() == 16
    assert (batch.context.masks is None) == (not masked)
    assert not batch.context.images[0].equal(batch.context.images[4 * 3])  # the ball falls
    if masked:
        assert 0.1 < batch.context.masks.float().mean() < 0.6
        assert (
            0.01 < batch.context.dynamic.float().mean() < 0.2
            and not (batch.context.dynamic & ~batch.context.masks).any()
        )
