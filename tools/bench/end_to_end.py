"""The whole latent model of the paper on a GPU: encode, one step, render, one training step; time and memory.

    python tools/bench/end_to_end.py --device cuda

"captured" rows are replays of a CUDA graph of the same call, geometry included, with sizes 1.25 times those needed; the others
are the calls as Python makes them.

The dynamics read the scene of which the authors' release was once recorded on an H200 (its own network code, spconv 2.3.8,
random weights, 129 input and 67 output channels, voxels of 4 mm): a ground disc and an ellipsoid that sinks 4 cm a step;
masked means the ellipsoid alone.
"""

import dataclasses
import math
from functools import partial

import torch
from harness import Bench

from gsim3d import presets
from gsim3d.dynamics import Dynamics
from gsim3d.graphs import Captured, CapturedRollout, rounded
from gsim3d.ops import PyramidCapacity
from gsim3d.simulator import Simulator
from gsim3d.types import Cameras, Frames, Particles

SIZE, NEAR, FAR = 128, 1.2, 4.0
RELEASE = "authors' release, recorded"
RECORDED = {  # (steps of history, masked) -> forward, forward and backward [ms]
    (4, True): (56.2, 103.0),
    (2, True): (44.2, 105.0),
    (4, False): (63.5, 169.0),
    (2, False): (50.6, 124.0),
}
TARGET = {(4, False): (15, 50), (2, False): (10, 35), (4, True): (4, 12), (2, True): (3, 9)}


def recorded_scene(n_steps: int, n: int, moving_share: float) -> torch.Tensor:
    """[T, n, 3] metres."""
    g = torch.Generator(device="cuda").manual_seed(0)
    n_body = int(n * moving_share)
    n_ground = n - n_body
    angle = 6.2832 * torch.rand(n_ground, device="cuda", generator=g)
    radius = 1.5 * torch.rand(n_ground, device="cuda", generator=g).sqrt()
    height = 0.003 * torch.rand(n_ground, device="cuda", generator=g)
    ground = torch.stack([radius * angle.cos(), radius * angle.sin(), height], -1)
    direction = torch.randn(n_body, 3, device="cuda", generator=g)
    body = direction / direction.norm(dim=-1, keepdim=True) * torch.tensor([0.25, 0.2, 0.22], device="cuda")
    lift = torch.tensor([0.0, 0.0, 1.0], device="cuda")
    return torch.stack([torch.cat([ground, body + (0.9 - 0.04 * t) * lift]) for t in range(n_steps)])


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


def ring(n_views: int, n_clouds: int) -> Cameras:
    """Cameras on a circle that look at the middle; each cloud is seen by all of them."""
    poses = []
    for view in range(n_views):
        angle = 2 * math.pi * view / n_views
        center = torch.tensor([2.2 * math.cos(angle), 2.2 * math.sin(angle), 1.2], dtype=torch.float64)
        forward = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64) - center, dim=0)
        right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        right = torch.nn.functional.normalize(right, dim=0)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ center
        poses.append(pose.float())
    n = n_views * n_clouds
    K = torch.tensor([[1.2 * SIZE, 0.0, SIZE / 2], [0.0, 1.2 * SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
    bounds = torch.full((n,), NEAR), torch.full((n,), FAR)
    clouds = torch.arange(n_clouds).repeat_interleave(n_views)
    return Cameras(torch.stack(poses).repeat(n_clouds, 1, 1), K.repeat(n, 1, 1), *bounds, clouds, SIZE, SIZE).to("cuda")


def random_frames(n_scenes: int, n_steps: int, n_views: int, kept: float) -> Frames:
    """``kept``: share of pixels that become particles."""
    n_clouds = n_scenes * n_steps
    g = torch.Generator(device="cuda").manual_seed(2)
    size = (n_clouds * n_views, SIZE, SIZE)
    return Frames(
        images=torch.rand(size[0], 3, SIZE, SIZE, device="cuda", generator=g),
        cameras=ring(n_views, n_clouds),
        cloud_scene=torch.arange(n_scenes, device="cuda").repeat_interleave(n_steps),
        cloud_step=torch.arange(n_steps, device="cuda").repeat(n_scenes),
        origin=torch.full((n_scenes, 3), -4.0, dtype=torch.float64, device="cuda"),
        masks=torch.rand(size, device="cuda", generator=g) < kept if kept < 1 else None,
    )


def peak_gib(f) -> float:
    torch.cuda.reset_peak_memory_stats()
    f()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() / 2**30


def measure(bench: Bench, case: str, f, dtype: torch.dtype, *, peers=None, target_ratio=None) -> None:
    """The autocast context stays open, as in a rollout: weights are rounded once."""
    with torch.autocast("cuda", dtype, enabled=dtype != torch.float32):
        memory = None
        try:
            memory = peak_gib(f)
        except torch.cuda.OutOfMemoryError:
            print(f"{case}: out of memory")
        if memory is None:  # behind the handler, which keeps what the failed call made
            return torch.cuda.empty_cache()
        name = str(dtype).removeprefix("torch.")
        bench.gpu(f"{case}, {memory:.1f} GiB", name, f, peers or {}, target_ratio=target_ratio, tolerance=None, capture=False)


def dynamics(bench: Bench, n_steps: int, masked: bool, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    model = Dynamics(presets.paper_latent(n_steps, 64).dynamics).cuda().eval()
    state = particles_at(recorded_scene(n_steps, 16384 if masked else 65536, 1.0 if masked else 0.2))
    state = state.with_clouds(state.clouds)
    inference = model if dtype == torch.float32 else rounded(model, dtype)
    capacity = PyramidCapacity.of(model.geometry(state), state.n_rows)

    def forward(model=model, capacity=None):
        with torch.no_grad():
            return model(state, pyramid=model.geometry(state, capacity=capacity)).means

    def both(capacity=None):
        out = model(state, pyramid=model.geometry(state, capacity=capacity))
        return torch.autograd.grad(out.means.sum() + out.dynamic_latents.sum(), list(model.parameters()), allow_unused=True)

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
    simulator = Simulator(presets.paper_latent(4, 64)).cuda().eval()
    frames, cameras = random_frames(1, 4, 4, 1.0), ring(9, 1)

    with torch.no_grad():
        measure(bench, "encode 4 steps x 4 views, 128 px", lambda: simulator.encode(frames).means, dtype)
        state = simulator.encode(frames)
        newest = simulator.rollout(state, 1)[0]
        measure(bench, "render 9 views of 65k particles, 128 px", lambda: simulator.render(newest, cameras).color, dtype)
        view = ring(1, 1)
        measure(bench, "step + one 128 px view, 65k particles a step",
                lambda: simulator.render(simulator.rollout(state, 1)[0], view).color, dtype)  # fmt: skip
        for n_steps in (1, 12):
            with torch.autocast("cuda", dtype):
                captured = CapturedRollout(simulator, state, n_steps, cameras=view, copies=False)
            measure(bench, f"{n_steps} x (step + one 128 px view), captured", lambda: captured(state), dtype)


def training(bench: Bench, dtype: torch.dtype) -> None:
    """4 past steps, 12 future ones fed back, 4 scenes, 4 input and 9 target views, a quarter of the pixels kept; blocks are
    computed again in the backward pass, as the authors do."""
    torch.manual_seed(0)
    n_scenes, n_past, n_future, n_views = 4, 4, 12, 9
    model = presets.paper_latent(n_past, 64)
    model = dataclasses.replace(model, dynamics=dataclasses.replace(model.dynamics, checkpointing=True))
    simulator = Simulator(model).cuda().train()
    optimizer = torch.optim.AdamW(simulator.parameters(), lr=1e-5)
    frames = random_frames(n_scenes, n_past, 4, 0.25)
    targets = ring(n_views, n_scenes)
    truth = torch.rand(n_scenes * n_views, SIZE, SIZE, 3, device="cuda")

    def step():
        torch.clear_autocast_cache()  # the weights have changed
        optimizer.zero_grad(set_to_none=True)
        state = simulator.encode(frames)
        steps = simulator.rollout(state, n_future)
        last = state.select_clouds(torch.arange(n_past - 1, n_scenes * n_past, n_past, device="cuda"))
        loss = sum((simulator.render(s, targets).color - truth).square().mean() for s in [last, *steps])
        loss.backward()
        optimizer.step()
        return loss.detach()

    measure(bench, "training step 4-1-12, batch 4, masked", step, dtype, peers={"authors' paper (H100)": 4300.0}, target_ratio=4)


def main():
    bench = Bench("end_to_end")
    if bench.device.type != "cuda":
        raise SystemExit("end_to_end measures the full-size model, which needs a GPU: add --device cuda")
    for n_steps, masked in RECORDED:
        dynamics(bench, n_steps, masked, torch.bfloat16)
    training(bench, torch.bfloat16)
    whole(bench, torch.bfloat16)
    for n_steps, masked in RECORDED:
        dynamics(bench, n_steps, masked, torch.float32)
    bench.finish()


if __name__ == "__main__":
    main()
