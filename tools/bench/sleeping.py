"""What a step costs where most of a scene rests: time against the share of rows at rest.

    python tools/bench/sleeping.py                  # small, on the CPU
    python tools/bench/sleeping.py --device cuda    # 65k points, captured, with and without one 128 px view

The scene is a ground disc and an ellipsoid that sinks; those of its rows that are nearest to the middle move, the rest
is the background of a model with ``background="asymmetric"``. The peer of every row ("torch" on the CPU) is the same
model when nothing rests. Weights are random: times do not depend on them. "agreement" is the PSNR between the last
images of a rollout whose background is computed once and of one that computes it in every step.
"""

import dataclasses
import math
import time

import torch
from harness import Bench

from gsim3d import presets
from gsim3d.cameras import Cameras
from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.dynamics import Partition, RestLog
from gsim3d.simulator import Simulator
from gsim3d.state import DYNAMIC, FROZEN, Particles, append_step, last_steps

SHARES = (0.5, 0.9, 0.99)
SIZE = 128
LIMIT_MS = 1000 / 160


def scene(model: Simulator, n_steps: int, n: int, resting: float, device: str) -> Particles:
    """One scene of n rows a step, of which this share rests."""
    widths = [model.config.dynamics.dynamic_latents, 1, model.config.dynamics.static_latents]
    g = torch.Generator(device).manual_seed(0)
    n_body = max(1, n // 10)
    angle = 6.2832 * torch.rand(n - n_body, device=device, generator=g)
    radius = 1.5 * torch.rand(n - n_body, device=device, generator=g).sqrt()
    ground = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.zeros_like(angle)], -1)
    direction = torch.randn(n_body, 3, device=device, generator=g)
    body = direction / direction.norm(dim=-1, keepdim=True) * torch.tensor([0.25, 0.2, 0.22], device=device)
    middle = torch.tensor([0.0, 0.0, 0.25], device=device)
    rows = torch.cat([ground, body + middle])
    moves = torch.zeros(n, dtype=torch.bool, device=device)
    moves[(rows - middle).norm(dim=-1).argsort(stable=True)[: n - round(resting * n)]] = True
    sinking = torch.tensor([0.0, 0.0, -0.01], device=device)
    means = torch.stack([torch.where(moves[:, None], rows + t * sinking, rows) for t in range(n_steps)])
    features = 0.1 * torch.randn(n, sum(widths), device=device, generator=g).repeat(n_steps, 1)
    dynamic, opacity, static = features.split(widths, 1)
    return Particles(
        means=means.reshape(-1, 3),
        opacities=opacity[:, 0].sigmoid(),
        dynamic_latents=dynamic,
        static_latents=static,
        cu_rows=torch.arange(0, (n_steps + 1) * n, n, device=device),
        cloud_scene=torch.zeros(n_steps, dtype=torch.int64, device=device),
        cloud_step=torch.arange(n_steps, device=device),
        activity=torch.where(moves, DYNAMIC, FROZEN).to(torch.uint8).repeat(n_steps),
        origin=torch.full((1, 3), -2.0, dtype=torch.float64, device=device),
    )


def view(device: str) -> Cameras:
    """From above, to the middle."""
    pose = torch.eye(4)
    pose[1, 1] = pose[2, 2] = -1.0
    pose[2, 3] = 3.0
    K = torch.tensor([[1.0 * SIZE, 0.0, SIZE / 2], [0.0, 1.0 * SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
    bounds = torch.tensor([1.0]), torch.tensor([5.0])
    return Cameras(pose[None], K[None], *bounds, torch.zeros(1, dtype=torch.int64), SIZE, SIZE).to(device)


def simulator(n_steps: int, device: str) -> Simulator:
    torch.manual_seed(0)
    model = presets.paper_latent(n_steps, 64) if device == "cuda" else presets.tiny()
    dynamics = dataclasses.replace(model.dynamics, background="asymmetric", norm="layer", max_step=0.001)
    renderer = dataclasses.replace(model.renderer, initial_scale=0.01)  # about half a pixel
    return Simulator(dataclasses.replace(model, dynamics=dynamics, renderer=renderer)).to(device).eval()


def agreement(model: Simulator, state: Particles, n_steps: int, device: str) -> float:
    """dB between the last images with a background made once and made in every step."""
    once = model.rollout(state, n_steps)[-1]
    for _ in range(n_steps):
        state = append_step(state, model.dynamics(state), model.plan().history)
    images = [model.render(step, view(device)).color for step in (once, last_steps(state, 1))]
    wrong = (images[0] - images[1]).square().mean().item()
    return math.inf if wrong == 0 else -10 * math.log10(wrong)


@torch.no_grad()
def on_gpu(bench: Bench, n: int = 65536, n_steps: int = 4, horizon: int = 12) -> None:
    model = simulator(n_steps, "cuda")

    def captured(share, cameras):
        state = scene(model, n_steps, n, share, "cuda")
        rollout = CapturedRollout(model, state, horizon, cameras=cameras, copies=False)
        return (lambda: rollout(state)), rollout._graph

    with torch.autocast("cuda", torch.bfloat16):
        for what, cameras, limit in (
            ("step", None, None),
            ("step + one 128 px view", view("cuda"), LIMIT_MS * horizon),
        ):
            awake, graph_awake = captured(0.0, cameras)
            for share in SHARES:
                case = f"{horizon} x ({what}), {share:.0%} of 65k points rest"
                options = {"limit_ms": limit, "target_ratio": 3 if share == 0.9 else None}
                ours, graph = captured(share, cameras)
                options["graphs"] = {"gsim3d": graph, "nothing rests": graph_awake}
                bench.gpu(case, "bfloat16", ours, {"nothing rests": awake}, tolerance=None, **options)
        rests = Partition.of(scene(model, n_steps, n, 0.9, "cuda"), asymmetric=True).background
        bench.gpu("the background, 59k points", "bfloat16", lambda: model.dynamics.remember(rests), {}, capture=False)
        decibels = agreement(model, scene(model, n_steps, n, 0.9, "cuda"), horizon, "cuda")
        print(f"agreement of {horizon} steps with a background made in every step: {decibels:.1f} dB")


@torch.no_grad()
def on_cpu(bench: Bench, n: int = 6000, n_steps: int = 2, horizon: int = 4) -> None:
    model = simulator(n_steps, "cpu")
    dynamics, awake = model.dynamics, Partition.of(scene(model, n_steps, n, 0.0, "cpu"), asymmetric=True)
    nothing, saved, made = dynamics.remember(awake.background), {}, {}
    for share in SHARES:
        parts = Partition.of(scene(model, n_steps, n, share, "cpu"), asymmetric=True)
        background = dynamics.remember(parts.background)
        row = bench.compare(
            f"a step, {share:.0%} of {n} rows rest",
            lambda: dynamics(parts.moving, background=background),
            lambda: dynamics(awake.moving, background=nothing),
            tolerance=None,
        )
        saved[share] = row["torch"]["ms"] - row["gsim3d"]["ms"]
        row = bench.compare(
            f"the background, {share:.0%} of {n} rows",
            lambda: dynamics.remember(parts.background),
            lambda: dynamics(awake.moving, background=nothing),
            tolerance=None,
        )
        made[share] = row["gsim3d"]["ms"]
    for share in SHARES:
        print(f"{share:.0%} at rest: a background pays for itself after {made[share] / saved[share]:.1f} steps")
    log, begin = RestLog(), time.perf_counter()
    model.rollout(scene(model, n_steps, n, 1.0, "cpu"), horizon, log=log)
    print(f"{horizon} steps, all rest: {1e3 * (time.perf_counter() - begin):.1f} ms, {log.calls} calls of the network")
    decibels = agreement(model, scene(model, n_steps, n, 0.9, "cpu"), horizon, "cpu")
    print(f"agreement of {horizon} steps with a background made in every step: {decibels:.1f} dB")


def main():
    bench = Bench("sleeping")
    (on_gpu if bench.args.device == "cuda" else on_cpu)(bench)
    bench.finish()


if __name__ == "__main__":
    main()
