"""Time and memory of a whole training step on synthetic batches of true size.

    python tools/bench/training.py --device cuda                                         # paper_latent, 4-1-12, batch 4
    torchrun --nproc-per-node 4 tools/bench/training.py --device cuda --case recomputed  # this batch for each process

The step is the one of `gsim3d train`: encode, 12 steps fed back, images of 5 views at all 16 steps, gradients,
clipping, AdamW, averaged weights; with drop path, shuffled curves and deterministic algorithms. The images, masks and
where particles lie are those of surface_scene.py. With several processes every one gets ``--batch`` scenes; the
efficiency of scaling is the time of a step in one process, measured before they begin, over the time in all of them.
"""

import argparse
import functools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path

import surface_scene
import torch
from harness import RESULTS, commit

from gsim3d.train.config import DataConfig, PhaseConfig, PrecisionConfig, TrainConfig
from gsim3d.train.log import memory_gib
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.processes import Processes, joined
from gsim3d.train.samples import Batch

N_PAST, N_FUTURE, N_VIEWS, N_TARGETS = 4, 12, 4, 5
PUBLISHED = "the paper: 4.3 s a step and less than 20 GB (H100)"
LEAN = PrecisionConfig(encoder="bf16", dynamics="bf16", renderer="bf16")
FIXED = {"norm": "layer", "drop_path": 0.0, "shuffle_orders": False}  # what a captured step asks of a model


@dataclass(frozen=True)
class Case:
    """masked: the body alone. dynamics, recompute, captured: of the configuration."""

    masked: bool = True
    dynamics: dict = field(default_factory=dict)
    recompute: tuple[str, ...] = ()
    captured: bool = False


CASES = {
    "kept": Case(),
    "captured": Case(dynamics=FIXED, captured=True),
    "blocks": Case(dynamics={"checkpointing": True}),
    "recomputed": Case(recompute=("encoder", "steps")),
    "unmasked": Case(masked=False, dynamics={"checkpointing": True}, recompute=("encoder", "steps", "images")),
}


@dataclass
class SyntheticScene:
    """What a trainer asks a scene before it draws samples."""

    size: int
    name: str = "synthetic"
    path: str = "synthetic"
    n_steps: int = N_PAST + N_FUTURE
    n_cams: int = surface_scene.N_CAMS
    fps: float = 24.0

    @property
    def width(self) -> int:
        return self.size

    height = width


@functools.cache  # drawing the video takes longer than steps do
def synthetic_batch(n_scenes: int, size: int, masked: bool) -> tuple[Batch, torch.Tensor]:
    """A batch, and the places of the particles of its encoded steps."""
    generator = torch.Generator().manual_seed(0)
    targets = [
        torch.randperm(surface_scene.N_CAMS, generator=generator)[:N_TARGETS].tolist() for _ in range(N_PAST + N_FUTURE)
    ]
    context, places = surface_scene.frames(n_scenes, [surface_scene.evenly(N_VIEWS)] * N_PAST, size, masked)
    return Batch(context, surface_scene.frames(n_scenes, targets, size, masked)[0], N_PAST, N_FUTURE), places


def make_trainer(name: str, args: argparse.Namespace, processes: Processes, folder: str) -> Trainer:
    """The trainer of a case, which sees the same batch in every step."""
    case = CASES[name]
    config = TrainConfig(
        phases=(PhaseConfig(steps=1000, horizon=N_FUTURE, batch=args.batch * processes.count, target_views=N_TARGETS),),
        preset=args.preset,
        model={"dynamics": case.dynamics},
        data=DataConfig(history=N_PAST, context_views=N_VIEWS),
        precision=LEAN,
        recompute=case.recompute,
        captured=case.captured,
    )
    batch, places = synthetic_batch(args.batch, args.size, case.masked)
    trainer = Trainer(config, [SyntheticScene(args.size)], folder, device=args.device, processes=processes)
    surface_scene.as_if_trained(trainer.simulator, places.to(args.device))
    trainer.simulator.train()
    trainer._draw = lambda step, samples: batch
    return trainer


def timed_steps(trainer: Trainer, args: argparse.Namespace, processes: Processes) -> tuple[float, dict]:
    """Median seconds of a step, and what the last one logged."""
    seconds, entry = [], {}
    for _ in range(args.warm_up + args.steps):
        processes.gather(None)
        start = time.perf_counter()
        entry = trainer.train_step()  # reads the loss, so the device has finished
        if args.device == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
        if "skipped" in entry:
            raise SystemExit(f"training: {entry['skipped']}")
    return statistics.median(seconds[args.warm_up :]), entry


def measure(name: str, args: argparse.Namespace, processes: Processes) -> dict:
    """Time, memory and loss of a few steps."""
    with tempfile.TemporaryDirectory() as folder, deterministic():
        trainer = make_trainer(name, args, processes, folder)
        seconds, entry = timed_steps(trainer, args, processes)
        memory = max(processes.gather(memory_gib(args.device)))
    row = {
        "case": name,
        "preset": args.preset,
        "processes": processes.count,
        "batch": args.batch * processes.count,
        "particles": round(entry["particles"]),
        "seconds": round(seconds, 4),
        "gib": round(memory, 2),
        "loss": entry["loss"],
    }
    if args.device == "cuda":
        row |= {"gpu": torch.cuda.get_device_name(), "torch": torch.__version__, "commit": commit()}
        row["date"] = time.strftime("%Y-%m-%d", time.gmtime())
    return row


def alone(args: argparse.Namespace) -> dict[str, float]:
    """Seconds of a step of each case in one process, a child of this one; nothing where there is just one anyway."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or int(os.environ.get("RANK", "0")) > 0:
        return {}
    environment = {k: v for k, v in os.environ.items() if k not in ("WORLD_SIZE", "RANK", "LOCAL_RANK")}
    options = {"device": args.device, "preset": args.preset, "batch": args.batch, "size": args.size}
    options |= {"steps": args.steps, "warm-up": args.warm_up}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        command = [sys.executable, __file__, *(f"--{name}={value}" for name, value in options.items())]
        subprocess.run([*command, "--json", str(file), "--case", *args.case], env=environment, check=True)
        return {row["case"]: row["seconds"] for row in json.loads(file.read_text())} if file.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--preset", default="paper_latent")
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    parser.add_argument("--batch", type=int, default=4, help="scenes a step of each process")
    parser.add_argument("--size", type=int, default=128, help="pixels")
    parser.add_argument("--steps", type=int, default=3, help="that are timed; the median is shown")
    parser.add_argument("--warm-up", type=int, default=2, help="steps before them")
    parser.add_argument("--json", type=Path, help="write the rows here; on a GPU default tools/bench/results")
    args = parser.parse_args()
    rows, failed, file = [], [], args.json
    if file is None and args.device == "cuda":
        file = RESULTS / "training.json"
    before = alone(args)
    with joined(args.device) as processes:
        say = print if processes.is_first else lambda *_, **__: None
        say(f"{args.preset}, {N_PAST}-1-{N_FUTURE}, bf16, {args.size} px; {PUBLISHED}")
        say(
            f"{'case':<12}{'processes':>10}{'batch':>7}{'particles':>11}{'s a step':>10}{'peak GiB':>10}{'loss':>10}"
            f"{'efficiency':>12}"
        )
        for name in args.case:
            if args.device == "cuda":
                torch.cuda.empty_cache()
                torch.cuda.reset_peak_memory_stats()
            try:
                row = measure(name, args, processes)
            except Exception as error:
                if processes.count > 1:  # the others wait for this one
                    raise
                if isinstance(error, torch.cuda.OutOfMemoryError):
                    say(f"{name:<12} out of memory", flush=True)
                else:
                    traceback.print_exc()
                    failed.append(name)
                continue
            row["efficiency"] = round(before[name] / row["seconds"], 4) if name in before else None
            efficiency = f"{row['efficiency']:.0%}" if name in before else "-"
            say(
                f"{name:<12}{row['processes']:>10}{row['batch']:>7}{row['particles']:>11}{row['seconds']:>10.3f}"
                f"{row['gib']:>10.1f}{row['loss']:>10.5f}{efficiency:>12}",
                flush=True,
            )
            rows.append(row)
            if file is not None and processes.is_first:
                keep_rows(file, rows)
    if failed:
        raise SystemExit(f"training: {', '.join(failed)} failed, see above")


def keep_rows(file: Path, rows: list[dict]) -> None:
    """Writes ``rows`` in place of those of the same case and number of processes."""
    new = {(row["case"], row["processes"]) for row in rows}
    known = json.loads(file.read_text()) if file.exists() else []
    kept = [row for row in known if (row["case"], row["processes"]) not in new]
    file.parent.mkdir(exist_ok=True)
    file.write_text("[\n" + ",\n".join(json.dumps(row) for row in [*kept, *rows]) + "\n]\n")


if __name__ == "__main__":
    main()
