"""What effects cost: on, on and idle, and off.

    python tools/bench/effects.py [--device cuda]

"off" rows compare an effect that a plan switched off with a model that was built without it (wanted: at most 1.01 times
its time), "idle" rows an effect that is on and has nothing to do with one that is off (at most 1.05 times); both give
the same bits. "on" rows compare an effect with the same plan without it: this is its price; on a GPU that of a captured
rollout of a large scene, for there calls as Python makes them are launches for the most part. Weights are random, times
do not depend on them.
"""

import copy
import dataclasses

import torch
from harness import Bench
from sleeping import scene, view

from gsim3d import Simulator, presets
from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.effects.spec import EffectsSpec
from gsim3d.state import Particles

STEPS = 4  # of a rollout
FROZEN_SHARE = 0.5
OFF, IDLE = 1.01, 1.05  # times the time without the effect, at most
EDITABLE = {"structure": {"insert": True, "remove": True}}
EVERY_IMAGE = {"outputs": {"depth": True, "alpha": True}}


def rollout(simulator: Simulator, state: Particles, values: dict):
    plan = simulator.plan(EffectsSpec.from_dict(values))

    def run():
        return [step.means for step in simulator.rollout(state, STEPS, plan)]

    return run


def captured(simulator: Simulator, state: Particles, values: dict):
    graph = CapturedRollout(simulator, state, STEPS, simulator.plan(EffectsSpec.from_dict(values)), copies=False)
    return lambda: graph(state)


def images(simulator: Simulator, state: Particles, values: dict):
    plan, newest = simulator.plan(EffectsSpec.from_dict(values)), state.select_clouds([state.n_clouds - 1])
    cameras = view(str(state.means.device))

    def run():
        image = simulator._draw(newest, cameras, plan=plan)
        return image.depth if image.color is None else image.color

    return run


def without_merging(simulator: Simulator) -> Simulator:
    simulator = copy.deepcopy(simulator)
    for stage in simulator.dynamics.net.encoder:
        stage.merge = None
    return simulator


def of_degree_zero(simulator: Simulator) -> Simulator:
    """A simulator without harmonics of higher degrees."""
    config, weights = simulator.config, simulator.state_dict()
    n = config.renderer.n_harmonics
    for name in ("renderer.fc2.weight", "renderer.fc2.bias"):
        weights[name] = weights[name][[0, n, 2 * n, *range(3 * n, 3 * n + 7)]]
    flat = dataclasses.replace(config, renderer=dataclasses.replace(config.renderer, sh_degree=0))
    simulator = Simulator(flat).to(weights[name].device).eval()
    simulator.load_state_dict(weights)
    return simulator


def rows(config, n: int, device: str):
    """(case, with the effect, without it, at most so many times its time)."""
    torch.manual_seed(0)
    simulator = Simulator(config).to(device).eval()
    n_steps = 2**config.dynamics.history_bits
    state = scene(simulator, n_steps, n, FROZEN_SHARE, device)
    one = Simulator(dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, history_bits=0)))
    one, first = one.to(device).eval(), state.select_clouds([n_steps - 1])
    many = scene(simulator, n_steps, 4 * n, FROZEN_SHARE, device)
    large = many.select_clouds([n_steps - 1])  # an image is cheaper than a step
    plain = rollout(simulator, state, {}), images(simulator, large, {})
    flat = {"appearance": {"view_dependent": 0}}
    yield "off: time merging", rollout(one, first, {}), rollout(without_merging(one), first, {}), OFF
    degree_zero = images(of_degree_zero(simulator), large, {})
    yield "off: view-dependent colour", images(simulator, large, flat), degree_zero, OFF
    yield "idle: insertion, removal", rollout(simulator, state, EDITABLE), plain[0], IDLE
    yield "idle: sleep", rollout(simulator, state, {"dynamics": {"sleep": {"eps": 0.0}}}), plain[0], IDLE
    yield "idle: depth and alpha images", images(simulator, large, EVERY_IMAGE), plain[1], IDLE
    whole = plain[0] if device == "cpu" else captured(simulator, many, {})
    for case, less in (
        (f"time merging, {n_steps} steps for 1", {"dynamics": {"history": 1}}),
        (f"frozen background, {FROZEN_SHARE:.0%} of the rows", {"dynamics": {"background": "masked_out"}}),
        ("changing features", {"appearance": {"changing": "none"}}),
    ):
        without = rollout(simulator, state, less) if device == "cpu" else captured(simulator, many, less)
        yield f"on: {case}", whole, without, None
    case = f"on: view-dependent colour, degree {config.renderer.sh_degree}"
    yield case, plain[1], images(simulator, large, flat), None
    features = images(simulator, large, {"outputs": {"features": True}})
    yield f"on: feature images, {config.renderer.latents} channels", features, plain[1], None
    depth = images(simulator, large, {"outputs": {"rgb": False, "depth": True}})
    yield "on: colour images", images(simulator, large, {"outputs": {"depth": True}}), depth, None


@torch.no_grad()
def main():
    bench = Bench("effects")
    if bench.args.device == "cuda":
        with torch.autocast("cuda", torch.bfloat16):
            for case, run, plain, limit in rows(presets.paper_latent(4, 64), 16384, "cuda"):
                bench.cost(case, run, plain, dtype="bfloat16", tolerance=limit and 0.0, limit=limit)
    else:
        tiny = presets.tiny()
        config = dataclasses.replace(tiny, renderer=dataclasses.replace(tiny.renderer, sh_degree=3))
        for case, run, plain, limit in rows(config, 4000, "cpu"):
            bench.cost(case, run, plain, tolerance=limit and 0.0, limit=limit)
    bench.finish()


if __name__ == "__main__":
    main()
