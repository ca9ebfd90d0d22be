"""Time and memory of a whole training step on synthetic batches of true size.

    python tools/bench/training.py --device cuda                                         # paper_latent, 4-1-12, batch 4
    torchrun --nproc-per-node 4 tools/bench/training.py --device cuda --case recomputed  # this batch for each process

The step is the one of `gsim3d train`: encode, 12 steps fed back, images of 5 views at all 16 steps, gradients,
clipping, AdamW. A ball falls on a ground disc, seen by 12 cameras; masked means that pixels of neither are no
particles. With several processes every one gets ``--batch`` scenes, so that the time of a step against that of one
process is the efficiency of scaling.
"""

import argparse
import dataclasses
import json
import math
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from gsim3d.train.config import DataConfig, StageConfig, TrainConfig
from gsim3d.train.log import memory_gib
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.precision import PrecisionConfig
from gsim3d.train.processes import joined
from gsim3d.train.samples import Batch
from gsim3d.types import Cameras, Frames

N_CAMS, N_PAST, N_FUTURE, N_VIEWS, N_TARGETS = 12, 4, 12, 4, 5
NEAR, FAR, RADIUS, GROUND = 1.5, 8.0, 0.3, 1.0  # metres
PUBLISHED = "the paper: 4.3 s a step and less than 20 GB (H100)"
LEAN = PrecisionConfig(encoder="bf16", dynamics="bf16", renderer="bf16")
CASES = {  # name -> (masked, blocks computed again, parts computed again)
    "kept": (True, False, ()),
    "blocks": (True, True, ()),
    "recomputed": (True, False, ("encoder", "steps")),
    "unmasked": (False, True, ("encoder", "steps", "images")),
}


@dataclass
class SyntheticScene:
    """What a trainer asks a scene before it draws samples."""

    size: int
    name: str = "synthetic"
    path: str = "synthetic"
    n_steps: int = N_PAST + N_FUTURE
    n_cams: int = N_CAMS

    @property
    def width(self) -> int:
        return self.size

    height = width


def ring() -> torch.Tensor:
    """float64 [12, 4, 4] world-to-camera: cameras on a circle look at the middle."""
    poses = torch.eye(4, dtype=torch.float64).repeat(N_CAMS, 1, 1)
    for cam in range(N_CAMS):
        angle = 2 * math.pi * cam / N_CAMS
        place = torch.tensor([2.5 * math.cos(angle), 2.5 * math.sin(angle), 1.4], dtype=torch.float64)
        forward = torch.nn.functional.normalize(torch.tensor([0, 0, 0.4]) - place, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0, 0, 1.0]).double()), dim=0)
        poses[cam, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        poses[cam, :3, 3] = -poses[cam, :3, :3] @ place
    return poses


def film(viewmats: torch.Tensor, K: torch.Tensor, size: int, height: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Images [I, 3, size, size] and labels [I, size, size] of a ball at ``height`` above a chequered disc."""
    x = (torch.arange(size, dtype=torch.float64) + 0.5).expand(size, size)
    y = x.T
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    rays = torch.nn.functional.normalize(rays @ viewmats[:, None, :3, :3], dim=-1)
    origin = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[:, None, None, :, 0]
    reach = -origin[..., 2:] / rays[..., 2:].clamp(max=-1e-6)
    ground = (origin + rays * reach)[..., :2]
    labels = ((rays[..., 2] < 0) & (ground.norm(dim=-1) < GROUND)).to(torch.uint8)
    checks = (ground * 4).floor().sum(-1, keepdim=True) % 2
    images = torch.where(labels[..., None] == 1, 0.4 + 0.3 * checks, 0.0).expand(*labels.shape, 3).clone()
    to_center = torch.tensor([0, 0, height]) - origin
    along = (rays * to_center).sum(-1, keepdim=True)
    off = to_center.square().sum(-1, keepdim=True) - along.square()
    hit = ((off < RADIUS**2) & (along > 0))[..., 0]
    normal = (rays * (along - (RADIUS**2 - off).clamp(min=0).sqrt()) - to_center) / RADIUS
    images[hit], labels[hit] = 0.5 + 0.5 * normal[hit], 3
    return images.permute(0, 3, 1, 2).float(), labels


def synthetic_batch(n_scenes: int, size: int, masked: bool) -> Batch:
    viewmats, n_steps = ring(), N_PAST + N_FUTURE
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]], dtype=torch.float64)
    films = [film(viewmats, K, size, max(RADIUS, 1 - 0.008 * step**2)) for step in range(n_steps)]

    def frames(n: int, views: list[list[int]]) -> Frames:
        images, labels = (
            torch.cat([films[t][kind][views[t]] for t in range(n)]).repeat(n_scenes, *[1] * dims)
            for kind, dims in ((0, 3), (1, 2))
        )
        seen = torch.cat([torch.tensor(views[t]) for t in range(n)]).repeat(n_scenes)
        n_images = seen.shape[0]
        cameras = Cameras(
            viewmats=viewmats[seen].float(),
            Ks=K.float().repeat(n_images, 1, 1),
            near=torch.full((n_images,), NEAR),
            far=torch.full((n_images,), FAR),
            image_cloud=torch.arange(n_scenes * n).repeat_interleave(len(views[0])),
            width=size,
            height=size,
        )
        return Frames(
            images=images,
            cameras=cameras,
            cloud_scene=torch.arange(n_scenes).repeat_interleave(n),
            cloud_step=torch.arange(n).repeat(n_scenes),
            origin=torch.full((n_scenes, 3), -4.0, dtype=torch.float64),
            masks=labels > 0 if masked else None,
            dynamic=labels == 3 if masked else None,
        )

    generator = torch.Generator().manual_seed(0)
    targets = [torch.randperm(N_CAMS, generator=generator)[:N_TARGETS].tolist() for _ in range(n_steps)]
    context = [[cam * N_CAMS // N_VIEWS for cam in range(N_VIEWS)]] * N_PAST
    return Batch(frames(N_PAST, context), frames(n_steps, targets), N_PAST, N_FUTURE)


def measure(name: str, args: argparse.Namespace, processes) -> dict:
    """Time, memory and loss of a few steps."""
    masked, blocks, recompute = CASES[name]
    config = TrainConfig(
        stages=(StageConfig(steps=1000, horizon=N_FUTURE, batch=args.batch * processes.count, target_views=N_TARGETS),),
        preset=args.preset,
        model={"dynamics": {"checkpointing": blocks}},
        data=DataConfig(history=N_PAST, context_views=N_VIEWS),
        precision=LEAN,
        recompute=recompute,
    )
    batch = synthetic_batch(args.batch, args.size, masked)
    with tempfile.TemporaryDirectory() as folder, deterministic():
        trainer = Trainer(config, [SyntheticScene(args.size)], folder, device=args.device, processes=processes)
        trainer.simulator.train()
        trainer._draw = lambda step, samples: batch
        seconds, entry = [], {}
        for _ in range(args.warm_up + args.steps):
            processes.gather(None)
            start = time.perf_counter()
            entry = trainer.train_step()  # reads the loss, so the device has finished
            seconds.append(time.perf_counter() - start)
        if "skipped" in entry:
            raise SystemExit(f"{name}: {entry['skipped']}")
        memory = max(processes.gather(memory_gib(args.device)))
        if args.top and processes.count == 1:
            print_profile(trainer, args.device, args.top)
    return {
        "case": name,
        "processes": processes.count,
        "batch": args.batch * processes.count,
        "seconds": round(statistics.median(seconds[args.warm_up :]), 4),
        "gib": round(memory, 2),
        "particles": round(entry["particles"]),
        "loss": entry["loss"],
    }


def print_profile(trainer: Trainer, device: str, n_rows: int) -> None:
    """The operators and kernels that took longest in one more step."""
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (device == "cuda")
    with profile(activities=activities) as traced:
        trainer.train_step()
    averages = traced.key_averages()
    for key in [f"self_{side}_time_total" for side in (["cpu"] + ["device"] * (device == "cuda"))]:
        longest = sorted(averages, key=lambda event, key=key: -getattr(event, key))[:n_rows]
        total = sum(getattr(event, key) for event in averages)
        print(f"    {key}: {total / 1e6:.3f} s")
        for event in longest:
            print(f"    {getattr(event, key) / 1e6:9.3f} s {event.count:7d} x {event.key[:90]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--preset", default="paper_latent")
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    parser.add_argument("--batch", type=int, default=4, help="scenes a step of each process")
    parser.add_argument("--size", type=int, default=128, help="pixels")
    parser.add_argument("--steps", type=int, default=3, help="that are timed; the median is shown")
    parser.add_argument("--warm-up", type=int, default=2, help="steps before them")
    parser.add_argument(
        "--top", type=int, default=0, help="of one process, also show what took longest in one more step"
    )
    parser.add_argument("--json", type=Path, help="append the rows to this file")
    args = parser.parse_args()
    with joined(args.device) as processes:
        say = print if processes.is_first else lambda *_, **__: None
        say(f"{args.preset}, {N_PAST}-1-{N_FUTURE}, bf16, {args.size} px; {PUBLISHED}")
        say(f"{'case':<12}{'processes':>10}{'batch':>7}{'particles':>11}{'s a step':>10}{'peak GiB':>10}{'loss':>10}")
        for name in args.case:
            if args.device == "cuda":
                torch.cuda.empty_cache()
                torch.cuda.reset_peak_memory_stats()
            try:
                row = measure(name, args, processes)
            except torch.cuda.OutOfMemoryError:
                if processes.count > 1:
                    raise
                say(f"{name:<12} out of memory")
                continue
            say(
                f"{name:<12}{row['processes']:>10}{row['batch']:>7}{row['particles']:>11}{row['seconds']:>10.3f}"
                f"{row['gib']:>10.1f}{row['loss']:>10.5f}",
                flush=True,
            )
            if args.json and processes.is_first:
                with open(args.json, "a") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
