"""Invariances of a simulator with any weights, as metamorphic tests: a transformed input gives the transformed output.

    for deviation in INVARIANCES["permute particles"](simulator, sample):
        assert deviation.holds, deviation

An invariance is exact if it keeps all sums, and holds to a bound if their order or the positions change. Rollouts
amplify rounding, so invariances with a bound are checked for each step of a rollout from the same state; exact ones are
checked for the whole rollout.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.effects.plan import Plan
from gsim3d.math.rotations import quat_product, rotation_matrices, rotation_to_quat
from gsim3d.math.spherical_harmonics import rotate_harmonics
from gsim3d.nn.gaussian_head import render
from gsim3d.simulator import Simulator
from gsim3d.state import DYNAMIC, CloudTable, Gaussians, Particles, attributes_of, last_steps, newest_clouds, take_runs

EXACT = {torch.float32: 0.0, torch.float64: 1e-12}  # rounding of BLAS in float64 depends on the number of rows
BOUND = 1e-4  # error over the largest value, for float32 sums in another order; worst seen 7e-6, small random models
VELOCITY_BOUND = 1e-3  # for velocities fitted to images of noise; worst seen 2.9e-4
IMAGE_BOUND = 1e-3  # RMS error of an image: a splat whose alpha crosses 1/255 changes a pixel by 0.004
GRAIN = 2.0**-18  # metres; positions are rounded to it before a translation, which is then exact in float32
VELOCITIES = attributes_of("vector")
FROM_POSITIONS = (*attributes_of("point"), *VELOCITIES, "irradiance_gain", "light_occlusion")  # depend on positions
FAR = 2.0**17  # cells, outside the 2^16 cells of a grid


@dataclass(frozen=True)
class Sample:
    """Input of a check."""

    frames: Frames  #: input images of one or more scenes
    targets: Cameras  #: cameras to render; ``image_cloud`` is the scene of each
    n_steps: int = 3  #: steps of a rollout
    plan: Plan | None = None  #: what to compute; None: the simulator's default

    @property
    def n_scenes(self) -> int:
        return self.frames.origin.shape[0]


@dataclass(frozen=True)
class Deviation:
    """Error of a tensor against its expected value."""

    what: str  #: name of the tensor
    error: float  #: largest error over the largest expected value; absolute if ``bound`` is 0
    bound: float  #: largest allowed error; 0: equal bits
    where: str  #: camera or particle of the largest error

    @property
    def holds(self) -> bool:
        return self.error <= self.bound

    def __str__(self) -> str:
        wanted = f"at most {self.bound:g}" if self.bound else "equal bits"
        return f"{self.what}: error {self.error:.3g} ({wanted}), largest at {self.where}"


Check = Callable[[Simulator, Sample], Iterator[Deviation]]


def compare(what: str, actual: Tensor, expected: Tensor, bound: float, name_of: Callable[[int], str]) -> Deviation:
    """Deviation of ``actual`` from ``expected``, both [N, ...]. Non-finite values are an infinite error.

    Args:
        what: name of the tensor.
        actual: computed values.
        expected: expected values.
        bound: largest allowed error; 0: equal bits.
        name_of: index of the first dimension -> name.
    """
    if actual.shape != expected.shape:
        return Deviation(what, float("inf"), bound, f"shape {list(actual.shape)}, expected {list(expected.shape)}")
    if actual.numel() == 0:
        return Deviation(what, 0.0, bound, "nothing")
    error = (actual.detach().double() - expected.detach().double()).abs()
    error = torch.where(error.isfinite(), error, torch.inf).reshape(len(error), -1).amax(1)
    worst = int(error.argmax())
    scale = float(expected.detach().abs().max()) if bound else 1.0
    return Deviation(what, float(error[worst]) / max(scale, 1e-30), bound, name_of(worst))


def compare_particles(
    what: str, actual: Particles, expected: Particles, bound: float, names: Sequence[str] = ()
) -> Iterator[Deviation]:
    """Deviations of all floating-point attributes, or of those in ``names``."""
    for name, value in expected.row_fields().items():
        if value.is_floating_point() and (not names or name in names):
            most = VELOCITY_BOUND if bound == BOUND and name in VELOCITIES else bound
            yield compare(f"{what} {name}", getattr(actual, name), value, most, lambda i: particle_name(expected, i))


def compare_images(what: str, actual: Tensor, expected: Tensor, bound: float) -> Deviation:
    """Deviation of images [I, H, W, 3]; with a bound, the largest RMS error of an image."""
    if not bound or actual.shape != expected.shape:
        return compare(what, actual, expected, bound, lambda i: f"camera {i}")
    error = (actual.detach().double() - expected.detach().double()).square().flatten(1).mean(1).sqrt()
    error = torch.where(error.isfinite(), error, torch.inf)
    return Deviation(what, float(error.max()), bound, f"camera {int(error.argmax())}")


def particle_name(particles: Particles, index: int) -> str:
    """Name of a particle, such as "scene 0, step 3, particle 17"."""
    table = particles.clouds
    cloud = next(q for q in range(len(table)) if index < table.starts[q + 1])
    return f"scene {table.scenes[cloud]}, step {table.steps[cloud]}, particle {index - table.starts[cloud]}"


def select_images(frames: Frames, images: Tensor, image_cloud: Tensor | None = None) -> Frames:
    """Selects ``images`` (int64 [J]) of ``frames``; ``image_cloud`` replaces their clouds (None: unchanged)."""
    maps = {name: getattr(frames, name) for name in ("images", "masks", "dynamic", "valid")}
    maps = {name: None if value is None else value[images] for name, value in maps.items()}
    return dataclasses.replace(frames, **maps, cameras=frames.cameras.select(images, image_cloud))


def take_scenes(frames: Frames, scenes: Sequence[int]) -> Frames:
    """Selects scenes of ``frames`` in the given order, with repetitions."""
    cloud_scene, image_cloud = frames.cloud_scene.tolist(), frames.cameras.image_cloud.tolist()
    clouds = [(new, q) for new, scene in enumerate(scenes) for q, own in enumerate(cloud_scene) if own == scene]
    images = [(i, new) for new, (_, q) in enumerate(clouds) for i, cloud in enumerate(image_cloud) if cloud == q]
    device = frames.images.device
    image, image_cloud = (torch.tensor(column, device=device) for column in zip(*images, strict=True))
    new_scene, chosen = (torch.tensor(column, device=device) for column in zip(*clouds, strict=True))
    return dataclasses.replace(
        select_images(frames, image, image_cloud),
        cloud_scene=new_scene,
        cloud_step=frames.cloud_step[chosen],
        origin=frames.origin[list(scenes)],
        world_offset=None if frames.world_offset is None else frames.world_offset[list(scenes)],
        actions=frames.actions and frames.actions.select(scenes),
    )


def take_scenes_of_particles(particles: Particles, scenes: Sequence[int]) -> Particles:
    """Selects scenes of ``particles`` in the given order, with repetitions."""
    own = particles.clouds.scenes
    new_scene, clouds = zip(*((new, q) for new, scene in enumerate(scenes) for q in range(len(own)) if own[q] == scene))
    return dataclasses.replace(
        particles.select_clouds(clouds),
        cloud_scene=torch.tensor(new_scene, device=particles.cloud_scene.device),
        origin=particles.origin[list(scenes)],
        world_offset=None if particles.world_offset is None else particles.world_offset[list(scenes)],
        actions=particles.actions and particles.actions.select(scenes),
    )


def repack(particles: Particles, order: Tensor, counts: Iterable[int]) -> Particles:
    """Gathers the particles ``order`` (int64 [M]) into clouds of ``counts`` particles."""
    table = CloudTable.make(counts, particles.clouds.scenes, particles.clouds.steps, order.device)
    return particles.with_clouds(table, **{name: value[order] for name, value in particles.row_fields().items()})


def reordered(particles: Particles, order: Tensor) -> Particles:
    """Permutes particles within their clouds: particle i of the result is ``order[i]`` (int64 [N])."""
    return dataclasses.replace(particles, **{name: value[order] for name, value in particles.row_fields().items()})


def random_order(particles: Particles) -> Tensor:
    """Random permutation of the particles of each cloud, int64 [N]; the same one for clouds of equal sizes, so that the
    particles of simulated steps still correspond."""
    table = particles.clouds
    order = [torch.randperm(n, generator=torch.Generator().manual_seed(0)) for n in table.counts]
    order = torch.cat([start + within for start, within in zip(table.starts[:-1], order, strict=True)])
    return order.to(particles.means.device)


def move_cameras(cameras: Cameras, rotation: Tensor, translation: Tensor) -> Cameras:
    """Cameras after the world moved by ``x -> rotation x + translation``, in float64."""
    motion = torch.eye(4, dtype=torch.float64, device=rotation.device)
    motion[:3, :3], motion[:3, 3] = rotation.T, -rotation.T @ translation
    return dataclasses.replace(cameras, viewmats=cameras.viewmats.double() @ motion)


def move_gaussians(gaussians: Gaussians, rotation: Tensor, translation: Tensor) -> Gaussians:
    """Gaussians after the world moved by ``x -> rotation x + translation``."""
    quat = rotation_to_quat(rotation[None]).to(gaussians.quats)
    matrices = rotation.to(gaussians.sh).expand(gaussians.sh.shape[0], 3, 3)
    return dataclasses.replace(
        gaussians,
        means=(gaussians.means.double() @ rotation.T + translation).to(gaussians.means),
        quats=quat_product(quat.expand_as(gaussians.quats), gaussians.quats),
        sh=rotate_harmonics(gaussians.sh, matrices),
    )


def random_motion(seed: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Random rotation [3, 3] by 60 to 120 degrees and random translation [3] of about a metre."""
    g = torch.Generator().manual_seed(seed)
    quat = torch.randn(1, 4, generator=g, dtype=torch.float64)
    quat[0, 0] = quat[0, 1:].norm() * (0.6 + torch.rand((), generator=g, dtype=torch.float64))
    rotation = rotation_matrices(quat / quat.norm())[0]
    return rotation.to(like.device), torch.randn(3, generator=g, dtype=torch.float64).to(like.device)


def voxel_shift(simulator: Simulator, like: Tensor) -> Tensor:
    """Translation float64 [3] of about (2, -3, 1) metres in whole voxels, rounded to GRAIN."""
    grid = simulator.config.dynamics.grid_size
    cells = (torch.tensor([2.0, -3.0, 1.0], dtype=torch.float64) / grid).round()
    return ((cells * grid / GRAIN).round() * GRAIN).to(like.device)


def _with_positions(particles: Particles, change: Callable[[Tensor], Tensor]) -> Particles:
    """Applies ``change`` (float64 -> float64) to all attributes of kind "point"."""
    points = {name: value for name in attributes_of("point") if (value := getattr(particles, name)) is not None}
    return dataclasses.replace(particles, **{name: change(x.double()).to(x.dtype) for name, x in points.items()})


def _moved(particles: Particles, shift: Tensor) -> Particles:
    moved = _with_positions(particles, lambda positions: positions + shift)
    actions = particles.actions
    if actions is not None:
        positions = (actions.positions.double() + shift).to(actions.positions)
        actions = dataclasses.replace(actions, positions=positions)
    return dataclasses.replace(moved, origin=particles.origin + shift, actions=actions)


def _states(simulator: Simulator, sample: Sample) -> Iterator[Particles]:
    """Yields the encoded state and the states of a rollout, each with its history."""
    state = simulator.encode(sample.frames).detach()
    for step in range(sample.n_steps):
        yield state
        if step + 1 < sample.n_steps:
            state = simulator.step(state, sample.plan).detach()


def _future(simulator: Simulator, state: Particles, sample: Sample) -> list[Particles]:
    return [step.detach() for step in simulator.rollout(state, sample.n_steps, sample.plan)]


def _exact(particles: Particles) -> float:
    """Bound for sums that are equal on the CPU; rounding of BLAS on a GPU depends on the number of rows."""
    dtype = particles.means.dtype
    return BOUND if particles.means.is_cuda and dtype == torch.float32 else EXACT[dtype]


def _color(simulator: Simulator, particles: Particles, cameras: Cameras) -> Tensor:
    return simulator.render(particles, cameras).color.detach()


def _in_float64(cameras: Cameras) -> Cameras:
    return dataclasses.replace(cameras, viewmats=cameras.viewmats.double())


@torch.no_grad()
def repeat(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """The same input twice gives equal bits."""
    state, again = (simulator.encode(sample.frames) for _ in range(2))
    yield from compare_particles("encode", again, state, 0)
    for step, other in zip(_future(simulator, state, sample), _future(simulator, again, sample), strict=True):
        yield from compare_particles("rollout", other, step, 0)
    image, picture = (_color(simulator, particles, sample.targets) for particles in (step, other))
    yield compare_images("render", picture, image, 0)


@torch.no_grad()
def translate(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A translation of scene, cameras and origin by whole voxels translates particles and keeps images."""
    shift = voxel_shift(simulator, sample.frames.origin)
    still = torch.eye(3, dtype=torch.float64, device=shift.device)
    frames = dataclasses.replace(sample.frames, cameras=_in_float64(sample.frames.cameras))
    cameras = move_cameras(frames.cameras, still, shift)
    moved = dataclasses.replace(frames, cameras=cameras, origin=frames.origin + shift)
    expected = simulator.encode(frames)
    yield from compare_particles("encode", _moved(simulator.encode(moved), -shift), expected, BOUND)
    for state in _states(simulator, sample):
        state = _with_positions(state, lambda positions: (positions / GRAIN).round() * GRAIN)
        step, there = simulator.step(state, sample.plan), simulator.step(_moved(state, shift), sample.plan)
        step, there = last_steps(step, 1), last_steps(there, 1)
        moved = [name for name in step.row_fields() if name in FROM_POSITIONS]
        unmoved = [name for name in step.row_fields() if name not in moved]
        yield from compare_particles("step", there, step, 0, unmoved)
        yield from compare_particles("step", _moved(there, -shift), step, BOUND, moved)
        targets = _in_float64(sample.targets)
        image = _color(simulator, step, targets)
        picture = _color(simulator, _moved(step, shift), move_cameras(targets, still, shift))
        yield compare_images("render", picture, image, IMAGE_BOUND)


@torch.no_grad()
def rotate(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A rigid motion of all cameras keeps depths; one of Gaussians and cameras keeps images."""
    rotation, translation = random_motion(0, sample.frames.origin)
    frames = dataclasses.replace(sample.frames, cameras=_in_float64(sample.frames.cameras))
    moved = dataclasses.replace(frames, cameras=move_cameras(frames.cameras, rotation, translation))
    expected, there = simulator.encode(frames), simulator.encode(moved)
    gaussians = simulator.renderer(last_steps(expected, 1))
    means = (expected.means.double() @ rotation.T + translation).to(expected.means)
    expected = dataclasses.replace(expected, means=means)
    yield from compare_particles("encode", there, expected, BOUND, ["means", "opacities"])
    targets = _in_float64(sample.targets)
    image = render(gaussians, targets).color
    there = move_gaussians(gaussians, rotation, translation)
    picture = render(there, move_cameras(targets, rotation, translation)).color
    yield compare_images("render", picture, image, IMAGE_BOUND)


@torch.no_grad()
def permute_particles(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A permutation of the particles of each cloud permutes the prediction and keeps images."""
    for state in _states(simulator, sample):
        order = random_order(state)
        step, other = (last_steps(simulator.step(s, sample.plan), 1) for s in (state, reordered(state, order)))
        runs = state.clouds.row_runs(newest_clouds(state.clouds))
        index = torch.empty_like(order)  # in the newest step, of each particle of the state
        index[take_runs(torch.arange(len(order), device=order.device), runs)] = torch.arange(step.n_rows).to(order)
        expected = reordered(step, index[take_runs(order, runs)])
        yield from compare_particles("step", other, expected, BOUND)
        image = _color(simulator, step, sample.targets)
        yield compare_images("render", _color(simulator, expected, sample.targets), image, IMAGE_BOUND)


@torch.no_grad()
def permute_views(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A permutation of the input views keeps the particles; one of the target cameras permutes the images."""
    frames, n_images = sample.frames, len(sample.frames.cameras)
    reverse = torch.arange(n_images - 1, -1, -1, device=frames.images.device)
    backwards = select_images(frames, reverse)
    state, other = simulator.encode(frames), simulator.encode(backwards)
    n_pixels = frames.images[0, 0].numel()
    pixels = _pixels_of_particles(backwards)  # of the reversed images
    pixels = (n_images - 1 - pixels // n_pixels) * n_pixels + pixels % n_pixels
    back = torch.argsort(pixels)[torch.argsort(torch.argsort(_pixels_of_particles(frames)))]
    yield from compare_particles("encode", reordered(other, back), state, BOUND)
    newest = last_steps(state, 1)
    image = _color(simulator, newest, sample.targets)
    reverse = torch.arange(len(sample.targets) - 1, -1, -1, device=image.device)
    yield compare_images("render", _color(simulator, newest, sample.targets.select(reverse)), image[reverse], 0)


def _pixels_of_particles(frames: Frames) -> Tensor:
    """image * H * W + pixel of each encoded particle, int64 [N]."""
    n_pixels = frames.images[0, 0].numel()
    order = torch.argsort(frames.cameras.image_cloud, stable=True)
    pixels = order[:, None] * n_pixels + torch.arange(n_pixels, device=order.device)
    return pixels.flatten() if frames.masks is None else pixels[frames.masks[order].flatten(1)]


def _compare_batches(simulator: Simulator, sample: Sample, scenes: Sequence[int]) -> Iterator[Deviation]:
    """Deviations of a batch of ``scenes`` from the sample; convolutions of the encoder round by number of images."""
    state = simulator.encode(sample.frames)
    packed = take_scenes_of_particles(state, scenes)
    yield from compare_particles("encode", simulator.encode(take_scenes(sample.frames, scenes)), packed, BOUND)
    step, other = simulator.step(state, sample.plan), simulator.step(packed, sample.plan)
    exact = _exact(state)
    yield from compare_particles("step", other, take_scenes_of_particles(step, scenes), exact)
    for step, other in zip(_future(simulator, state, sample), _future(simulator, packed, sample), strict=True):
        yield from compare_particles("rollout", other, take_scenes_of_particles(step, scenes), exact)
    image = _color(simulator, step, sample.targets)
    owner = sample.targets.image_cloud.tolist()
    chosen = [(i, new) for new, scene in enumerate(scenes) for i, own in enumerate(owner) if own == scene]
    images, clouds = torch.tensor(chosen, device=image.device).T
    picture = _color(simulator, other, sample.targets.select(images, clouds))
    yield compare_images("render", picture, image[images], IMAGE_BOUND if exact == BOUND else exact)


@torch.no_grad()
def permute_scenes(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A permutation of the scenes of a batch permutes the predictions."""
    yield from _compare_batches(simulator, sample, range(sample.n_scenes - 1, -1, -1))


@torch.no_grad()
def repeat_scene(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A scene that is twice in a batch has two equal predictions, and other scenes do not change."""
    yield from _compare_batches(simulator, sample, [*range(sample.n_scenes), 0])


@torch.no_grad()
def split_batch(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A scene alone has the same prediction as in a batch."""
    for scene in range(sample.n_scenes):
        yield from _compare_batches(simulator, sample, [scene])


@torch.no_grad()
def append_far_particle(simulator: Simulator, sample: Sample) -> Iterator[Deviation]:
    """A particle far outside the grid does not change, and neither do the others."""
    state = simulator.encode(sample.frames).detach()
    far, exact = FAR * simulator.config.dynamics.grid_size, _exact(state)
    grown = _with_far_particle(state, far)
    distant = _beyond(last_steps(grown, 1), far)
    for step, other in zip(_future(simulator, state, sample), _future(simulator, grown, sample), strict=True):
        yield from compare_particles("rollout", _beyond(other, far, False), step, exact)
        yield from compare_particles("the far particle's", _beyond(other, far), distant, 0)
    hidden = other.means[:, 0] > far / 2
    invisible = dataclasses.replace(other, opacities=other.opacities.masked_fill(hidden, 0))
    image, picture = (_color(simulator, particles, sample.targets) for particles in (step, invisible))
    yield compare_images("render", picture, image, IMAGE_BOUND if exact == BOUND else exact)


def _beyond(particles: Particles, far: float, wanted: bool = True) -> Particles:
    return particles.select_rows((particles.means[:, 0] > far / 2) == wanted)


def _with_far_particle(state: Particles, far: float) -> Particles:
    """Appends to each non-empty cloud a copy of its first particle, ``far`` metres away."""
    order, is_copy, counts = [], [], []
    for begin, end in pairwise(state.clouds.starts):
        rows = [*range(begin, end), *range(begin, min(begin + 1, end))]
        order += rows
        is_copy += [number >= end - begin for number in range(len(rows))]
        counts.append(len(rows))
    grown = repack(state, torch.tensor(order, device=state.means.device), counts)
    is_copy = torch.tensor(is_copy, device=state.means.device)
    return dataclasses.replace(
        grown,
        means=grown.means + far * is_copy[:, None],
        activity=grown.activity.masked_fill(is_copy, DYNAMIC),
        **{name: value * ~is_copy[:, None] for name in VELOCITIES if (value := getattr(grown, name)) is not None},
    )


INVARIANCES: dict[str, Check] = {
    "repeat": repeat,
    "translate": translate,
    "rotate": rotate,
    "permute particles": permute_particles,
    "permute views": permute_views,
    "permute scenes": permute_scenes,
    "repeat a scene": repeat_scene,
    "split the batch": split_batch,
    "append a far particle": append_far_particle,
}
