"""Stress tests of a simulator: long rollouts, gradients through rollouts, and degenerate inputs.

As in :mod:`gsim3d.testing.invariances`, a check is a function (simulator, sample) -> deviations.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.effects.plan import Plan
from gsim3d.errors import NumericalError
from gsim3d.numerics.report import StabilityReport
from gsim3d.simulator import Simulator
from gsim3d.state import Particles, last_steps
from gsim3d.testing.invariances import (
    Check,
    Deviation,
    Sample,
    particle_name,
    repack,
    select_images,
    take_scenes_of_particles,
)

MAX_MASS_DRIFT = 0.01  # largest relative change of the sum of opacities, if they are not predicted
GRADIENT_STEPS = 12


@dataclass(frozen=True)
class Curves:
    """Statistics of each step over all scenes."""

    kinetic_energy: list[float]  #: in (m/step)^2, for unit masses
    opacity_mass: list[float]  #: sum of opacities
    extent: list[float]  #: diagonal of the bounding box of the largest scene in metres
    speed: list[float]  #: largest displacement of a particle in m/step
    awake: list[int]  #: number of awake particles


def rollout_curves(
    simulator: Simulator, state: Particles, n_steps: int, plan: Plan | None = None, on_step=None
) -> Curves:
    """Statistics of a rollout of ``n_steps``, in the memory of one step. ``on_step`` is called with the newest
    particles after each step. Raises NumericalError as :meth:`Simulator.step`."""
    report, curves = StabilityReport(), Curves([], [], [], [], [])
    for _ in range(n_steps):
        before = last_steps(state, 1)
        state = simulator.step(state, plan, report=report).detach()
        newest = last_steps(state, 1)
        rows = report.statistics.values()
        curves.kinetic_energy.append(sum(row.kinetic_energy for row in rows))
        curves.opacity_mass.append(sum(row.opacity_mass for row in rows))
        curves.extent.append(max((row.extent for row in rows), default=0.0))
        same_rows = before.n_rows == newest.n_rows and newest.n_rows
        moved = (newest.means - before.means).norm(dim=1).max() if same_rows else 0.0
        curves.speed.append(float(moved))
        curves.awake.append(sum(row.awake for row in rows))
        report.clear()
        if on_step is not None:
            on_step(newest)
    return curves


def gradient_norms(
    simulator: Simulator, state: Particles, targets: Cameras, n_steps: int, plan: Plan | None = None
) -> tuple[list[float], dict[str, Tensor]]:
    """Gradients of the mean squared image of the last step of a rollout.

    Returns:
        Norms of the gradients with respect to the state (positions and dynamic latents) before each step, and
        parameter -> gradient.
    """
    state = state.detach()
    taps = []
    for _ in range(n_steps):
        taps += [state.means.requires_grad_(), state.dynamic_latents.requires_grad_()]
        state = simulator.step(state, plan)
    loss = simulator.render(last_steps(state, 1), targets).color.square().mean()
    parameters = dict(simulator.named_parameters())
    found = torch.autograd.grad(loss, [*taps, *parameters.values()], allow_unused=True)
    squares = [0.0 if g is None else float(g.double().square().sum()) for g in found[: len(taps)]]
    norms = [math.sqrt(a + b) for a, b in zip(squares[::2], squares[1::2], strict=True)]
    gradients = zip(parameters, found[len(taps) :], strict=True)
    return norms, {name: value for name, value in gradients if value is not None}


def _holds(what: str, ok: bool, where: str) -> Deviation:
    return Deviation(what, 0.0 if ok else math.inf, 0.0, where)


def _finite(what: str, particles: Particles) -> Iterator[Deviation]:
    """Checks that each attribute is finite; names the first particle that is not."""
    for name, value in particles.row_fields().items():
        if value.is_floating_point() and value.numel():
            bad = ~value.detach().reshape(len(value), -1).isfinite().all(1)
            row = int(bad.int().argmax())
            yield _holds(f"{what} {name} is finite", not bool(bad.any()), particle_name(particles, row))


def _finite_image(what: str, simulator: Simulator, particles: Particles, cameras: Cameras) -> Deviation:
    color = simulator.render(particles, cameras).color
    bad = ~color.isfinite().flatten(1).all(1)
    camera = int(bad.int().argmax()) if len(bad) else 0
    return _holds(f"{what} image is finite", not bool(bad.any()), f"camera {camera}")


def _runs_finite(what: str, simulator: Simulator, frames: Frames, sample: Sample) -> Iterator[Deviation]:
    """Checks that encoded particles, their rollout and its image are finite."""
    state = simulator.encode(frames)
    yield from _finite(f"{what}: encoded", state)
    yield from _rolls_finite(what, simulator, state, sample)


def _rolls_finite(what: str, simulator: Simulator, state: Particles, sample: Sample) -> Iterator[Deviation]:
    steps = simulator.rollout(state, sample.n_steps, sample.plan, report=StabilityReport())
    yield from _finite(f"{what}: rollout's", steps[-1])
    yield _finite_image(f"{what}:", simulator, steps[-1], sample.targets)


@torch.no_grad()
def images(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """Black, white and grey images, and empty masks: particles, rollouts and images are finite."""
    frames = sample.frames
    for name, value in {"black": 0.0, "white": 1.0, "grey": 0.5}.items():
        painted = dataclasses.replace(frames, images=torch.full_like(frames.images, value))
        yield from _runs_finite(f"{name} images", simulator, painted, sample)
    none = torch.zeros_like(frames.images[:, 0], dtype=torch.bool)
    yield from _runs_finite("nothing kept", simulator, dataclasses.replace(frames, masks=none), sample)


@torch.no_grad()
def few_views(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """One camera a step, and the same camera twice: particles, rollouts and images are finite."""
    frames = sample.frames
    cloud = frames.cameras.image_cloud.tolist()
    firsts = [cloud.index(q) for q in sorted(set(cloud))]
    chosen = {"one camera": firsts, "the same camera twice": [i for first in firsts for i in (first, first)]}
    for name, images in chosen.items():
        few = select_images(frames, torch.tensor(images, device=frames.images.device))
        yield from _runs_finite(name, simulator, few, sample)


@torch.no_grad()
def not_a_number(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """NaN or infinity in a pixel, a camera and a particle: an error names it, or the particle sleeps ("drop")."""
    frames = sample.frames
    last = len(frames.cameras) - 1
    pixels, viewmats = frames.images.clone(), frames.cameras.viewmats.clone()
    pixels[last, 0, 0, 0] = math.nan
    viewmats[last, 0, 0] = math.inf
    broken = {
        "a pixel": dataclasses.replace(frames, images=pixels),
        "a camera": dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, viewmats=viewmats)),
    }
    for name, bad in broken.items():
        yield _refuses(f"{name} that is not finite", lambda bad=bad: simulator.encode(bad), f"image {last}")
    state = simulator.encode(frames).detach()
    if not state.n_rows:
        return
    means = state.means.clone()
    means[-1, 1] = math.nan
    bad = dataclasses.replace(state, means=means)
    name = particle_name(state, state.n_rows - 1)
    scene = int(state.cloud_scene[-1])

    def rollout() -> None:
        report = StabilityReport()
        simulator.rollout(bad, 1, sample.plan, on_invalid="raise", report=report)
        report.check()  # synchronizes

    yield _refuses("a particle that is not finite", rollout, f"scene {scene}")
    steps = simulator.rollout(bad, sample.n_steps, sample.plan, on_invalid="drop", report=StabilityReport())
    yield from _finite(f"on_invalid='drop' with {name} not finite: rollout's", steps[-1])
    if sample.n_scenes > 1 and simulator.config.dynamics.origin_of_scene:
        clean = simulator.rollout(state, sample.n_steps, sample.plan)
        for step, expected in zip(steps, clean, strict=True):
            others = range(scene)
            step, expected = (take_scenes_of_particles(p, others) for p in (step, expected))
            same = torch.equal(step.means, expected.means) or step.means.dtype == torch.float64
            what = "scenes beside a particle that is not finite are bit-equal"
            yield _holds(what, same, f"step {expected.cloud_step.tolist()}")


def _refuses(what: str, call: Callable, names: str) -> Deviation:
    """Checks that ``call`` raises a NumericalError whose message contains ``names``."""
    message = ""
    try:
        call()
    except NumericalError as error:
        message = str(error)
    where = f"{names}; message: {message}" if message else f"{names}; no error"
    return _holds(f"{what}: a NumericalError names it", names in message, where)


@torch.no_grad()
def crowds(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """One particle, all particles at one position, and every particle twice: rollouts and images are finite."""
    state = simulator.encode(sample.frames).detach()
    first = state.cu_rows[state.row_cloud()]  # first particle of each particle's cloud
    number = torch.arange(state.n_rows, device=first.device)
    crowds = {
        "one particle": state.select_rows(number == first),
        "all at one position": dataclasses.replace(state, means=state.means[first]),
        "every particle twice": repack(
            state, number.repeat_interleave(2), [2 * count for count in state.clouds.counts]
        ),
    }
    for name, crowd in crowds.items():
        yield from _rolls_finite(name, simulator, crowd, sample)


@torch.no_grad()
def strange_cameras(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """Cameras inside a particle, facing away, and 1000 km away: images are finite."""
    newest = last_steps(simulator.encode(sample.frames).detach(), 1)
    targets = sample.targets.select(torch.zeros(1, dtype=torch.int64, device=newest.means.device))
    if not newest.n_rows:
        return
    rotation, inside = targets.viewmats[0, :3, :3], targets.viewmats.clone()
    inside[0, :3, 3] = -rotation @ newest.means[0].to(rotation)
    away, far = targets.viewmats.clone(), targets.viewmats.clone()
    away[0, 1:3] = -away[0, 1:3]
    far[0, 2, 3] += 1e6
    strange = {"inside a particle": inside, "facing away": away, "1000 km away": far}
    for name, viewmats in strange.items():
        camera = dataclasses.replace(targets, viewmats=viewmats)
        yield _finite_image(f"a camera {name}:", simulator, newest, camera)


def long_rollout(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A long rollout is finite, with bounded speed and, if opacities are not predicted, constant opacity mass."""
    state, bad = simulator.encode(sample.frames).detach(), []

    def collect(newest: Particles) -> None:
        bad.extend(deviation for deviation in _finite("rollout's", newest) if not deviation.holds)

    with torch.no_grad():
        curves = rollout_curves(simulator, state, sample.n_steps, sample.plan, collect)
    yield bad[0] if bad else _holds("every step of the rollout is finite", True, f"{sample.n_steps} steps")
    numbers = [*curves.kinetic_energy, *curves.extent]
    yield _holds("energy and extent are finite", all(map(math.isfinite, numbers)), f"{sample.n_steps} steps")
    limit, step = simulator.config.dynamics.max_step, max(range(sample.n_steps), key=curves.speed.__getitem__)
    limit = simulator.config.stability.max_speed if limit is None else math.sqrt(3) * limit
    yield Deviation("speed over its limit", curves.speed[step] / limit, 1 + 1e-6, f"step {step + 1} of the rollout")
    first = curves.opacity_mass[0] if curves.opacity_mass else 0.0
    if first and not simulator.config.dynamics.explicit:
        drift = [abs(mass / first - 1) for mass in curves.opacity_mass]
        step = max(range(len(drift)), key=drift.__getitem__)
        yield Deviation("opacity mass drifts", drift[step], MAX_MASS_DRIFT, f"step {step + 1} of the rollout")


def gradients(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """Gradients of the last image with respect to all earlier states and all parameters are finite."""
    state, n = simulator.encode(sample.frames).detach(), min(sample.n_steps, GRADIENT_STEPS)
    norms, of_parameters = gradient_norms(simulator, state, sample.targets, n, sample.plan)
    for step, norm in enumerate(norms):
        what, where = "the gradient with respect to a state is finite", f"{n - step} steps before the image"
        yield _holds(what, math.isfinite(norm), where)
    for name, gradient in of_parameters.items():
        yield _holds("the gradient of a parameter is finite", bool(gradient.isfinite().all()), name)


STRESS_TESTS: dict[str, Check] = {
    "images without content": images,
    "few and equal views": few_views,
    "what is not a number": not_a_number,
    "crowds": crowds,
    "strange cameras": strange_cameras,
    "a long rollout": long_rollout,
    "gradients": gradients,
}
