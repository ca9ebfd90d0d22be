"""What the default policy costs: a step of the simulator and an image of it, with its guards and without them.

    python tools/bench/stability.py [--device cuda] [--seconds 5]

Guards are one pass over all particles where a state enters and after every step, and the counts of the rasterizer. The
peer is the same without guards; results are the same bits. On a GPU of eager calls, which wait for Python, and of
replays of two CUDA graphs.
"""

import math
from contextlib import contextmanager
from functools import partial

import torch
from harness import Bench
from sleeping import scene, view

import gsim3d.numerics.validate
import gsim3d.simulator
from gsim3d import Simulator, ops, presets
from gsim3d.cameras import Cameras
from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.numerics.report import StabilityReport
from gsim3d.state import Particles

STEPS = 4  # of a rollout


@contextmanager
def no_guards():
    """Within it states are not validated, and what the rasterizer leaves out is not counted."""
    guard, render = gsim3d.simulator.validate_particles, gsim3d.simulator.render
    gsim3d.simulator.validate_particles = lambda particles, *args, **options: particles

    def uncounted(*args, report, on_invalid, **options):
        return render(*args, **options, on_invalid="drop")

    gsim3d.simulator.render = uncounted
    try:
        yield
    finally:
        gsim3d.simulator.validate_particles, gsim3d.simulator.render = guard, render


def run_of(simulator: Simulator, state: Particles, cameras: Cameras):
    def run():
        with torch.no_grad():
            steps = simulator.rollout(state, STEPS, report=StabilityReport())
            return [step.means for step in steps] + [simulator.render(steps[-1], cameras).color]

    return run


def without_guards(f):
    def run():
        with no_guards():
            return f()

    return run


def replays_of(simulator: Simulator, state: Particles, cameras: Cameras):
    """As run_of, with an image of every step, from CUDA graphs in bfloat16: guarded, and made without guards."""

    def graph():
        return CapturedRollout(simulator, state, STEPS, cameras=cameras, copies=False, report=StabilityReport())

    def replay_of(graph: CapturedRollout):
        def run():
            steps, images = graph(state)
            return [step.means for step in steps] + [images[-1].color]

        return run

    with torch.autocast("cuda", torch.bfloat16):
        guarded = graph()
        with no_guards():
            plain = graph()
    return replay_of(guarded), replay_of(plain)


def main():
    bench = Bench("stability")
    on_gpu = bench.device.type == "cuda"
    paper = presets.paper_latent(4, 64)
    cases = [("tiny", presets.tiny(), 4000), ("small", presets.small(), 16384 if on_gpu else 4000)]
    if on_gpu:
        cases += [("paper_latent", paper, 16384), ("paper_latent", paper, 65536)]
    for name, config, n in cases:
        torch.manual_seed(0)
        simulator = Simulator(config).to(bench.device).eval()
        n_steps = 2**config.dynamics.history_bits
        state, cameras = scene(simulator, n_steps, n, 0.0, bench.args.device), view(bench.args.device)
        run = run_of(simulator, state, cameras)
        case = f"{name}, {n} particles: {STEPS} steps"
        bench.cost(case + ", 1 image", run, without_guards(run))
        if on_gpu:
            captured = replays_of(simulator, state, cameras)
            bench.cost(case + f", {STEPS} images, captured", *captured, dtype="bfloat16")
    if on_gpu:
        look(bench)
    bench.finish()


def look(bench: Bench):
    """The op alone, against the same questions in plain torch."""
    n = 65536
    g = torch.Generator().manual_seed(0)
    means, opacities = torch.rand(n, 3, generator=g), torch.rand(n, generator=g)
    dynamic, static = torch.randn(n, 32, generator=g), torch.randn(n, 32, generator=g)
    fields = [x.to(bench.device) for x in (means, opacities, dynamic, static)]
    cu_rows, zero = torch.tensor([0, n], device=bench.device), torch.zeros(1, dtype=torch.int64, device=bench.device)
    origin = torch.zeros(1, 3, dtype=torch.float64, device=bench.device)
    activity = torch.zeros(n, dtype=torch.uint8, device=bench.device)
    previous = [fields[0] + 0.01, *fields[1:]]
    bounds = [(-math.inf, math.inf), (0.0, 1.0), (-1e4, 1e4), (-1e4, 1e4)]

    clouds = {"cloud_scene": zero, "origin": origin, "activity": activity, "grid_size": 0.01, "previous": previous}
    watch = partial(ops.validate_state, fields, bounds, cu_rows, **clouds)

    def ours():
        return watch().record[0, 12:15].float()

    def mended():
        return watch(neutral=[0.0] * 4).fields[2]

    def plain():
        good = torch.stack([((x >= a) & (x <= b)).reshape(n, -1).all(1) for x, (a, b) in zip(fields, bounds)]).all(0)
        cells = (fields[0].double() - origin) / 0.01
        good &= ((cells >= 0) & (cells < 2**16)).all(1) & (activity != 2)
        squared = (fields[0].double() - previous[0].double()).square().sum(1)
        return torch.stack([good.sum(), (squared * good).sum() / 2, fields[1].double().sum()]).float()

    bench.gpu(
        "validate_state, 65k rows of 68 channels", "float32", ours, {"torch": plain}, limit_ms=0.05, tolerance=1e-5
    )
    bench.gpu("validate_state, 65k rows of 68 channels, mended", "float32", mended, {}, limit_ms=0.05)


if __name__ == "__main__":
    main()
