"""The whole latent model of the paper on a GPU: encode, one step, render, one training step; time and memory.

    python tools/bench/end_to_end.py --device cuda

"captured" rows are replays of a CUDA graph of the same call, geometry included, with sizes 1.25 times those needed; the
others are the calls as Python makes them.

The dynamics read the scene of which the authors' release was once recorded on an H200 (its own network code, spconv
2.3.8, random weights, 129 input and 67 output channels, voxels of 4 mm): a ground disc and an ellipsoid that sinks 4 cm
a step; masked means the ellipsoid alone. Encoder, rollouts and training see a video of it, with particles at their true
places (surface_scene.py).
"""

import argparse
import tempfile
import traceback
from functools import partial

import surface_scene
import torch
import training
from harness import Bench

from gsim3d import presets
from gsim3d.cameras import Cameras
from gsim3d.cuda_graphs import Captured, CapturedRollout, rounded
from gsim3d.dynamics import Dynamics
from gsim3d.ops import PyramidCapacity
from gsim3d.simulator import Simulator
from gsim3d.state import Particles
from gsim3d.train.loop import deterministic
from gsim3d.train.processes import Processes

SIZE = 128
RELEASE = "authors' release, recorded"
RECORDED = {  # (steps of history, masked) -> forward, forward and backward [ms]
    (4, True): (56.2, 103.0),
    (2, True): (44.2, 105.0),
    (4, False): (63.5, 169.0),
    (2, False): (50.6, 124.0),
}
TARGET = {(4, False): (15, 50), (2, False): (10, 35), (4, True): (4, 12), (2, True): (3, 9)}


def particles_at(means: torch.Tensor, latents: int = 64) -> Particles:
    """One scene whose steps are the rows of ``means`` [T, n, 3]."""
    n_steps, n, _ = means.shape
    g = torch.Generator(device="cuda").manual_seed(1)
    features = 0.1 * torch.randn(n_steps * n, 2 * latents + 1, device="cuda", generator=g)
    dynamic, opacity, static = features.split([latents, 1, latents], 1)
    return Particles(
        means=means.reshape(-1, 3),
        opacities=opacity[:, 0].sigmoid(),
        dynamic_latents=dynamic,
        static_latents=static,
        cu_rows=torch.arange(0, (n_steps + 1) * n, n, device="cuda"),
        cloud_scene=torch.zeros(n_steps, dtype=torch.int64, device="cuda"),
        cloud_step=torch.arange(n_steps, device="cuda"),
        activity=torch.zeros(n_steps * n, dtype=torch.uint8, device="cuda"),
        origin=torch.full((1, 3), -2.0, dtype=torch.float64, device="cuda"),
    )


def peak_gib(f) -> float:
    torch.cuda.reset_peak_memory_stats()
    f()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() / 2**30


def measure(bench: Bench, case: str, f, dtype: torch.dtype, *, name=None, peers=None, target_ratio=None) -> None:
    """The autocast context stays open, as in a rollout: weights are rounded once. ``name``: of the dtype, for what
    chooses its own."""
    with torch.autocast("cuda", dtype, enabled=dtype != torch.float32):
        memory = None
        try:
            memory = peak_gib(f)
        except torch.cuda.OutOfMemoryError:
            print(f"{case}: out of memory")
        if memory is None:  # behind the handler, which keeps what the failed call made
            return torch.cuda.empty_cache()
        name = name or str(dtype).removeprefix("torch.")
        bench.gpu(
            f"{case}, {memory:.1f} GiB", name, f, peers or {}, target_ratio=target_ratio, tolerance=None, capture=False
        )


def dynamics(bench: Bench, n_steps: int, masked: bool, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    model = Dynamics(presets.paper_latent(n_steps, 64).dynamics).cuda().eval()
    state = particles_at(surface_scene.points(n_steps, 16384 if masked else 65536, 1.0 if masked else 0.2))
    state = state.with_clouds(state.clouds)
    inference = model if dtype == torch.float32 else rounded(model, dtype)
    capacity = PyramidCapacity.of(model.geometry(state), state.n_rows)

    def forward(model=model, capacity=None):
        with torch.no_grad():
            return model(state, pyramid=model.geometry(state, capacity=capacity)).means

    def both(capacity=None):
        out = model(state, pyramid=model.geometry(state, capacity=capacity))
        return torch.autograd.grad(
            out.means.sum() + out.dynamic_latents.sum(), list(model.parameters()), allow_unused=True
        )

    name = f"dynamics T={n_steps}, {'16k masked' if masked else '65k'} points a step"
    graphs = partial(forward, inference, capacity), partial(both, capacity)
    calls = zip(("fwd", "fwd+bwd"), (forward, both), graphs, RECORDED[n_steps, masked], TARGET[n_steps, masked])
    for what, call, to_capture, recorded, target in calls:
        numbers = {"peers": {RELEASE: recorded}, "target_ratio": round(recorded / target, 1)}
        measure(bench, f"{name}: {what}", call, dtype, **numbers)
        with torch.autocast("cuda", dtype, enabled=dtype != torch.float32):
            captured = Captured(to_capture)
        measure(bench, f"{name}: {what}, captured", captured, dtype, **numbers)
        del captured


def whole(bench: Bench, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    frames, places = surface_scene.frames(1, [surface_scene.evenly(4)] * 4, SIZE, masked=False)
    simulator = Simulator(presets.paper_latent(4, 64)).cuda().eval()
    surface_scene.as_if_trained(simulator, places.cuda())
    frames, cameras = frames.to("cuda"), seen_by(surface_scene.evenly(9))

    with torch.no_grad():
        measure(bench, "encode 4 steps x 4 views, 128 px", lambda: simulator.encode(frames).means, dtype)
        state = simulator.encode(frames)
        newest = simulator.rollout(state, 1)[0]
        measure(
            bench, "render 9 views of 65k particles, 128 px", lambda: simulator.render(newest, cameras).color, dtype
        )
        view = seen_by([0])
        measure(bench, "step + one 128 px view, 65k particles a step",
                lambda: simulator.render(simulator.rollout(state, 1)[0], view).color, dtype)  # fmt: skip
        for n_steps in (1, 12):
            with torch.autocast("cuda", dtype):
                captured = CapturedRollout(simulator, state, n_steps, cameras=view, copies=False)
            measure(bench, f"{n_steps} x (step + one 128 px view), captured", lambda: captured(state), dtype)


def seen_by(cams: list[int]) -> Cameras:
    """These cameras see one cloud."""
    return surface_scene.cameras(cams, torch.zeros(len(cams), dtype=torch.int64), SIZE).to("cuda")


def training_step(bench: Bench) -> None:
    """A step of `gsim3d train` from a graph; training.py measures it, and others, in more detail."""
    options = argparse.Namespace(device="cuda", preset="paper_latent", batch=4, size=SIZE)
    with tempfile.TemporaryDirectory() as folder, deterministic():
        trainer = training.make_trainer("captured", options, Processes(), folder)
        measure(bench, "training step 4-1-12, batch 4, masked, layer norms, simulated steps captured",
                trainer.train_step, torch.float32, name="bfloat16", peers={"authors' paper (H100)": 4300.0},
                target_ratio=4.3)  # fmt: skip
    del trainer
    torch.cuda.empty_cache()


def main():
    bench = Bench("end_to_end")
    if bench.device.type != "cuda":
        raise SystemExit("end_to_end measures the full-size model, which needs a GPU: add --device cuda")
    parts = [partial(dynamics, bench, *case, torch.bfloat16) for case in RECORDED]
    parts += [partial(training_step, bench), partial(whole, bench, torch.bfloat16)]
    parts += [partial(dynamics, bench, *case, torch.float32) for case in RECORDED]
    n_failed = sum(not is_done(part) for part in parts)
    bench.finish()
    if n_failed:
        raise SystemExit(f"end_to_end: {n_failed} parts failed, see above")


def is_done(part) -> bool:
    """Whether ``part`` ran to its end: the others are measured all the same."""
    try:
        part()
    except Exception:
        traceback.print_exc()
        torch.cuda.empty_cache()
        return False
    return True


if __name__ == "__main__":
    main()
