"""Spring-Gaus: an elastic object fitted to one trajectory, as a baseline of ``gsim3d evaluate``.

Isotropic Gaussians are fitted to frame 0, bound to a spring-mass system, and its initial velocity, stiffness, friction
and softness to the first frames by rendering. As published, but for choices of our own: Gaussians begin in the visual
hull of the masks with free sizes, and are not densified, in a third of the iterations; the velocity begins at that of
the masks' centroids, because from 0 its rate reaches at most 0.175 m/s; beside the object, a flat ground is fitted.

Source: Zhong et al. 2024, "Reconstruction and Simulation of Elastic Objects with Spring-Mass 3D Gaussians".
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.baselines.spring_mass import GRAVITY, SpringState, advance_safely, bind, build_springs, friction, softness
from gsim3d.cameras import Cameras
from gsim3d.data import Scene
from gsim3d.data.recording import FIXED, MOVING
from gsim3d.errors import InputError
from gsim3d.evaluate.metrics import ssim
from gsim3d.io.terminal import progress
from gsim3d.ops import rasterize_gaussians

COARSE, FINE = 48, 40  # voxels along the longest side, of the bounds and of the object
GROUND = 64  # Gaussians along each side of the ground
ADAM = {"eps": 1e-15}
RATES = {"means": 1.6e-4, "colors": 2.5e-3, "opacities": 0.05, "scales": 5e-3}
APPEARANCE = {name: RATES[name] for name in ("colors", "opacities", "scales")}
LATE_MEANS = 1.6e-6  # rate of the positions in the dynamic stage


@dataclass(frozen=True)
class SpringGausConfig:
    """Settings of a fit; the defaults are the published ones for synthetic scenes."""

    fit_frames: int | None = 24  #: frames that are fitted; None: as many as the model is given; 0: all of the scene
    anchors: int = 2048  #: largest number of anchors
    neighbors: int = 256  #: springs of each anchor
    edge: float = 0.01  #: metres, of the voxels whose centres are anchors
    stiffness: float = 1000.0  #: first value of each anchor
    damping: float = 0.1  #: along the springs, constant; none while the velocity is fitted
    substeps: int = 100  #: of a frame; ``more_substeps`` are added at a third and two thirds of the dynamic stage
    more_substeps: int = 50  #: see above; also added where a number is not finite
    static_iterations: int = 10_000  #: of Adam on frame 0
    ground_iterations: int = 1000  #: of Adam on the ground of frame 0, from all cameras
    refine_iterations: int = 3000  #: of appearance with bound positions, before each of the two next stages
    velocity_iterations: int = 100  #: passes through the frames before contact
    dynamic_iterations: int = 300  #: passes through all fitted frames
    hit_frame: int = 4  #: frames of the velocity stage
    seed: int = 123  #: of anchors and cameras


BASELINES = {
    "spring-gaus": SpringGausConfig(),
    "spring-gaus-given": SpringGausConfig(fit_frames=None, dynamic_iterations=0),
    "spring-gaus-all": SpringGausConfig(fit_frames=0),
}


def baseline(name: str, device: str = "cpu") -> SpringGaus:
    """Returns the baseline ``name`` of BASELINES. Raises InputError if there is none."""
    if name not in BASELINES:
        raise InputError(f"--baselines: {name!r} is not known; choose from {', '.join(BASELINES)}")
    return SpringGaus(name, BASELINES[name], device)


class SpringGaus:
    """Predictions of Spring-Gaus, fitted to each scene when they are read; the target cameras are not fitted.

    Attributes:
        name: name in tables and reports.
        folder: "fitted", where other predictions have a folder.
        config: settings of the fits.
    """

    def __init__(self, name: str, config: SpringGausConfig, device: str = "cpu"):
        self.name, self.folder, self.config, self.device = name, "fitted", config, torch.device(device)
        self._last, self._seconds = (None, None), 0.0  # key of the last fit, and the fit; its seconds with images

    def cameras(self, scene: Scene) -> tuple[int, ...]:
        """Returns every fourth camera: the others are fitted."""
        return tuple(range(0, scene.n_cams, 4))

    def check(self, scene: Scene, cams: Sequence[int], n_encoded: int, n_future: int) -> None:
        """Raises InputError where the method does not apply: no labels, no flat ground, actors, or several bodies."""
        others = [cam for cam in range(scene.n_cams) if cam not in cams]
        reason = None
        if not scene.has_segmentation():
            reason = "the scene has no masks of the object"
        elif len(others) < 2:
            reason = f"{len(others)} cameras are left to fit"
        elif scene.has_actions():
            reason = "an actor moves the object"
        elif scene.ground_height is None or not (scene.segmentation(others, [0]) == FIXED).any():
            reason = "there is no ground"
        else:
            facts, seen = scene.generated, _count_bodies(_hull(scene, others, COARSE)[1])
            n_bodies = max(seen, len(facts.get("bodies", [])) + ("cloth" in str(facts.get("world"))))
            if n_bodies != 1:
                reason = f"{n_bodies} bodies (a cloth is one), and it simulates one"
        if reason:
            raise InputError(f"{scene.path}: {self.name} is not applicable: {reason}")

    def images(self, scene: Scene, cams: list[int], n_encoded: int, n_future: int) -> Tensor:
        """Fits the scene; returns ``n_future`` steps after the first ``n_encoded``, uint8 [n_future, V, H, W, 3]."""
        fit, began = self._fit(scene, cams, n_encoded), perf_counter()
        images = _as_bytes(fit.images(cams, range(n_encoded, n_encoded + n_future), fit.ground)).cpu()
        self._seconds = fit.seconds + perf_counter() - began
        return images

    def object_images(self, scene: Scene, cams: list[int], n_encoded: int, n_future: int) -> Tensor:
        """Returns the same images of the object alone, on black."""
        return _as_bytes(self._fit(scene, cams, n_encoded).images(cams, range(n_encoded, n_encoded + n_future)))

    def points(self, scene: Scene, cams: list[int], n_encoded: int, n_future: int) -> Tensor:
        """Returns the anchors [1 + n_future, N, 3] from the last of the first ``n_encoded`` steps on."""
        return self._fit(scene, cams, n_encoded).anchors(range(n_encoded - 1, n_encoded + n_future)).cpu()

    def found(self) -> dict:
        """Returns what the last fit found, in how many substeps a frame (friction acts in each), the number of fitted
        values, and the seconds of its start, even if shared, its dynamics and its images."""
        fit = self._last[1]
        numbers = {"stiffness": 10 ** fit.stiffness.mean(), "grip": friction(fit._friction), "softness": fit._softness}
        found = {name: value.item() for name, value in numbers.items()}
        fitted = [fit.velocity, *([fit.stiffness, fit._friction, fit._softness] if fit.losses else [])]
        fitted += [rows for splats in (fit.object, fit.ground) for rows in splats.rows.values()]
        facts = {"substeps": fit.substeps, "parameters": sum(map(torch.numel, fitted)), "seconds": self._seconds}
        return {**facts, "velocity": fit.velocity.tolist(), **found}

    def _fit(self, scene: Scene, cams: Sequence[int], n_encoded: int) -> Fit:
        wanted = self.config.fit_frames
        count = n_encoded if wanted is None else min(wanted or scene.n_steps, scene.n_steps)
        others = tuple(cam for cam in range(scene.n_cams) if cam not in cams)
        key = (scene.path, scene.width, scene.height, others, count)
        if self._last[0] != key:
            self._last = key, _started(scene, others, count, self.config, self.device).with_dynamics(count, self.config)
        return self._last[1]


_STARTED: dict = {}  # the last start: fits to more or less frames of a scene share it


def _started(scene: Scene, cams: tuple[int, ...], count: int, config: SpringGausConfig, device: torch.device) -> Fit:
    first = min(config.hit_frame, count)
    key = (scene.path, scene.width, scene.height, cams, first, device, FINE, GROUND)
    key += (replace(config, fit_frames=0, dynamic_iterations=0),)
    if key not in _STARTED:
        _STARTED.clear()
        _STARTED[key] = Fit(scene, cams, first, config, device)
    return _STARTED[key]


class Fit:
    """One scene, fitted to frame 0 and the velocity of the first frames when it is made; then :meth:`with_dynamics`.

    Attributes:
        object, ground: Gaussians at frame 0.
        springs: anchors and springs.
        velocity: [3] m/s at frame 0.
        stiffness: log10 of each anchor's, [N].
        losses: losses of the dynamic stage, means over a pass.
        substeps: of a frame, at the end.
        seconds: that the stages took.
    """

    def __init__(self, scene: Scene, cams: Sequence[int], count: int, config: SpringGausConfig, device: torch.device):
        self.scene, self.config, self.device, self._cams, began = scene, config, device, cams, perf_counter()
        self.height, self.substeps, self.losses = scene.ground_height or 0.0, config.substeps, []
        self._load(count)
        labels = scene.segmentation(cams, [0]).to(device)[0] != MOVING
        images = scene.images(cams, [0]).to(device)[0].permute(0, 2, 3, 1).float() / 255
        axes, inside = _hull(scene, cams, FINE)
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)[inside].to(device)
        cell = float(axes[0][1] - axes[0][0])
        self.object = Splats(points, _seen_colors(points, self._cameras[0], self._objects[0]), cell / 2)
        self.ground = self._fit_ground(images * labels[..., None], labels)
        extent = _extent(self._cameras[0])
        self._fit_appearance("static", config.static_iterations, 0.2, RATES | {"means": extent * RATES["means"]})
        rest = self.object.rows["means"].detach()
        options = {"n_anchors": config.anchors, "n_neighbors": config.neighbors, "edge": config.edge}
        self.springs = build_springs(rest, **options, seed=config.seed)
        self._indices, self._weights = bind(rest, self.springs.rest)
        self._start_parameters()
        self._fit_appearance("appearance", config.refine_iterations, 0.2, APPEARANCE)
        self._fit_velocity(rest - self._bound(self.springs.rest))
        self.object.rows["means"] = self._bound(self.springs.rest).requires_grad_()
        self._fit_appearance("bound appearance", config.refine_iterations, 0.05, APPEARANCE)
        self.seconds = perf_counter() - began

    def _load(self, count: int) -> None:
        """Reads the first ``count`` frames: cameras, and images of the object on black."""
        steps = range(count)
        self._generator = torch.Generator().manual_seed(self.config.seed)
        self._cameras = [self.scene.cameras_at(self._cams, [step]).to(self.device) for step in steps]
        images = self.scene.images(self._cams, steps).to(self.device).permute(0, 1, 3, 4, 2).float() / 255
        self._objects = images * (self.scene.segmentation(self._cams, steps).to(self.device) == MOVING)[..., None]

    def _start_parameters(self) -> None:
        n, device = len(self.springs.rest), self.device
        self.stiffness = torch.full((n,), self.config.stiffness, device=device).log10().requires_grad_()
        self._friction = torch.tensor(-1.0, device=device, requires_grad=True)
        self._softness = torch.zeros((), device=device, requires_grad=True)

    def _bound(self, anchors: Tensor) -> Tensor:
        return (self._weights[..., None] * anchors[self._indices]).sum(1)

    def _loss(self, frame: int, means: Tensor, share: float) -> Tensor:
        """(1 - share) L1 + share (1 - SSIM) of one random camera."""
        camera = int(torch.randint(len(self._objects[frame]), (), generator=self._generator))
        image = self.object.render(self._cameras[frame].select(slice(camera, camera + 1)), means)
        target = self._objects[frame][camera : camera + 1]
        similar = ssim(image.clamp(0, 1), target).mean().float()
        return (1 - share) * (image - target).abs().mean() + share * (1 - similar)

    def _fit_ground(self, images: Tensor, counted: Tensor) -> Splats:
        """Flat Gaussians on the ground, fitted to what is not the object in frame 0."""
        low, high = torch.from_numpy(self.scene.bounds).float()
        axes = [torch.linspace(float(low[k]), float(high[k]), GROUND) for k in range(2)]
        points = torch.cartesian_prod(*axes)
        points = torch.cat([points, torch.full((len(points), 1), self.height)], 1).to(self.device)
        edge = float((high - low)[:2].max() / (GROUND - 1))
        ground = Splats(points, _seen_colors(points, self._cameras[0], images), edge / 2, opacity=2.0)
        adam = ground.optimizer(APPEARANCE)
        for _ in range(self.config.ground_iterations):
            loss = ((ground.render(self._cameras[0]) - images).abs().mean(-1) * counted).mean()
            _step(adam, loss)
        return ground

    def _fit_appearance(self, stage: str, iterations: int, share: float, rates: dict[str, float]) -> None:
        """Adam on frame 0 over what has a rate; that of positions falls to LATE_MEANS / RATES["means"] of it."""
        adam = self.object.optimizer(rates)
        decay = (LATE_MEANS / RATES["means"]) ** (1 / max(1, iterations)) if "means" in rates else 1.0
        with progress(None, stage, iterations, unit="step") as bar:
            for _ in range(iterations):
                _step(adam, self._loss(0, self.object.rows["means"], share))
                adam.param_groups[0]["lr"] *= decay
                bar.update()

    def _fit_velocity(self, offset: Tensor) -> None:
        """Gaussians move from where they began, ``offset`` from the mean of their anchors."""
        self.velocity = self._seen_velocity().requires_grad_()
        adam = torch.optim.Adam([self.velocity], lr=1e-3, **ADAM)
        halve = torch.optim.lr_scheduler.StepLR(adam, 100, 0.5)
        with progress(None, "velocity", self.config.velocity_iterations, unit="pass") as bar:
            for _ in range(self.config.velocity_iterations):
                self._pass(0.2, adam, halve, damping=0.0, soft=False, offset=offset)
                bar.update()
        self.velocity = self.velocity.detach()

    def _seen_velocity(self) -> Tensor:
        """Velocity [3] m/s by which the centre of the masks falls freely from first to last frame; 0 if unknown."""
        masks = [self._objects[frame].amax(-1) > 0 for frame in (0, -1)]
        seen = (masks[0].flatten(1).any(1) & masks[1].flatten(1).any(1)).nonzero()[:, 0]
        seconds = (len(self._cameras) - 1) / self.scene.fps
        if seconds == 0 or len(seen) < 2:
            return torch.zeros(3, device=self.device)
        first, last = (_centre(self._cameras[frame], masks[frame], seen) for frame in (0, -1))
        return (last - first) / seconds + first.new_tensor([0, 0, GRAVITY * seconds / 2])

    def with_dynamics(self, count: int, config: SpringGausConfig) -> Fit:
        """Returns a fit of stiffness, friction and softness to the first ``count`` frames; this one stays as it is."""
        fit, began = copy.copy(self), perf_counter()
        fit.config, fit.object, fit.losses = config, self.object.copy(), []
        fit._load(count)
        fit._start_parameters()
        fit.velocity = self.velocity
        adam = torch.optim.Adam([fit.stiffness, fit._friction, fit._softness], lr=1e-3, **ADAM)
        late = fit.object.optimizer(APPEARANCE | {"means": LATE_MEANS})
        with progress(None, "dynamics", config.dynamic_iterations, unit="pass") as bar:
            for number in range(config.dynamic_iterations):
                if number and number in (config.dynamic_iterations // 3, 2 * config.dynamic_iterations // 3):
                    fit.substeps += config.more_substeps
                fit.losses.append(fit._pass(0.05, adam, None, damping=config.damping))
                _step(late, fit._loss(0, fit.object.rows["means"], 0.05))
                bar.update()
        fit._rolled = [SpringState(self.springs.rest, torch.zeros_like(self.springs.rest))]
        fit.seconds += perf_counter() - began
        return fit

    def _pass(self, share, adam, schedule, *, damping: float, soft: bool = True, offset: Tensor | float = 0) -> float:
        """Returns the mean loss of all frames after the first, with a step of Adam each; gradients end at the frame."""
        state, total = SpringState(self.springs.rest, torch.zeros_like(self.springs.rest)), 0.0
        parameters = [p for group in adam.param_groups for p in group["params"]]
        for frame in range(1, len(self._cameras)):
            state = self._advance(frame, state, damping, soft)
            loss = self._loss(frame, self._bound(state.positions) + offset, share)
            adam.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            adam.step()
            if schedule is not None:
                schedule.step()
            state, total = SpringState(*(part.detach() for part in state)), total + loss.detach()
        return float(total) / max(1, len(self._cameras) - 1)

    def _advance(self, frame: int, state: SpringState, damping: float, soft: bool) -> SpringState:
        k = self.springs.lengths.shape[1]
        factors = softness(self._softness, k) if soft else torch.ones(k, device=self.device)
        started = SpringState(state.positions, state.velocities + self.velocity)
        given = {"stiffness": 10**self.stiffness, "factors": factors, "grip": friction(self._friction)}
        given |= {"seconds": 1 / self.scene.fps, "ground": self.height, "damping": damping}
        ended, self.substeps = advance_safely(
            frame, self.substeps, self.config.more_substeps, state=started, springs=self.springs, **given
        )
        return SpringState(ended.positions, ended.velocities - self.velocity)

    @torch.no_grad()
    def anchors(self, steps: range) -> Tensor:
        """Returns the positions [S, N, 3] of the anchors at ``steps``."""
        while len(self._rolled) < steps.stop:
            step, state = len(self._rolled), self._rolled[-1]
            self._rolled.append(self._advance(step, state, self.config.damping, soft=True))
        return torch.stack([self._rolled[step].positions for step in steps])

    @torch.no_grad()
    def images(self, cams: Sequence[int], steps: range, beside: Splats | None = None) -> Tensor:
        """Returns images [S, V, H, W, 3] in [0, 1] of the object at ``steps``, with others ``beside`` it."""
        means = [self._bound(anchors) for anchors in self.anchors(steps)]
        cameras = [self.scene.cameras_at(cams, [step]).to(self.device) for step in steps]
        drawn = [self.object.render(*pair, beside) for pair in zip(cameras, means, strict=True)]
        return torch.stack(drawn).clamp(0, 1)


class Splats:
    """Isotropic Gaussians with colours and opacities behind sigmoids.

    Attributes:
        rows: the parameters: means [N, 3], colors [N, 3] and opacities [N] (logits), scales [N] (log, metres).
    """

    def __init__(self, points: Tensor, colors: Tensor, scale: float, opacity: float = -2.2):
        n = len(points)
        start = {"means": points, "colors": colors.clamp(0.02, 0.98).logit()}
        start |= {"opacities": points.new_full((n,), opacity), "scales": points.new_full((n,), scale).log()}
        self.rows = {name: value.clone().requires_grad_() for name, value in start.items()}

    def copy(self) -> Splats:
        """Returns a copy, whose optimizers leave this one as it is."""
        copied = copy.copy(self)
        copied.rows = {name: value.detach().clone().requires_grad_() for name, value in self.rows.items()}
        return copied

    def optimizer(self, rates: dict[str, float]) -> torch.optim.Adam:
        """Returns Adam over the parameters that have a rate, in their order."""
        groups = [{"params": [self.rows[name]], "lr": rate} for name, rate in rates.items()]
        return torch.optim.Adam(groups, **ADAM)

    def render(self, cameras: Cameras, means: Tensor | None = None, beside: Splats | None = None) -> Tensor:
        """Returns images [I, H, W, 3] on black, of these at ``means`` and of others ``beside`` them."""
        parts = [self] + ([beside] if beside else [])
        places = [self.rows["means"] if means is None else means] + ([beside.rows["means"]] if beside else [])
        joined = {name: torch.cat([part.rows[name] for part in parts]) for name in ("colors", "opacities", "scales")}
        scales, means = joined["scales"].exp()[:, None].expand(-1, 3), torch.cat(places)
        quats = means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4)
        opacities, colors = joined["opacities"].sigmoid(), joined["colors"].sigmoid()
        return rasterize_gaussians(means, quats, scales, opacities, cameras, colors=colors).color


def _extent(cameras: Cameras) -> float:
    """1.1 times the largest distance of a camera from the mean of all."""
    centers = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
    return 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())


def _centre(cameras: Cameras, masks: Tensor, seen: Tensor) -> Tensor:
    """The point [3] nearest to the rays through the centroids of the masks [I, H, W] of the cameras ``seen``."""
    pixels = torch.stack([mask.nonzero().flip(1).float().mean(0) + 0.5 for mask in masks[seen]])
    poses = torch.linalg.inv(cameras.viewmats[seen])
    rays = poses[:, :3, :3] @ torch.linalg.solve(cameras.Ks[seen], F.pad(pixels, (0, 1), value=1))[..., None]
    across = torch.eye(3, device=rays.device) - rays @ rays.mT / rays.square().sum(1, keepdim=True)
    return (torch.linalg.pinv(across.sum(0), hermitian=True) @ (across @ poses[:, :3, 3:]).sum(0))[:, 0]


def _as_bytes(images: Tensor) -> Tensor:
    return images.mul(255).round().to(torch.uint8)


def _step(adam: torch.optim.Adam, loss: Tensor) -> None:
    adam.zero_grad()
    loss.backward()
    adam.step()


def _hull(scene: Scene, cams: Sequence[int], count: int) -> tuple[list[Tensor], Tensor]:
    """Centres of voxels along each axis (``count`` along the longest), and which are in all masks of frame 0, bool."""
    masks = scene.segmentation(cams, [0])[0] == MOVING
    cameras, box = scene.cameras_at(cams, [0]), torch.from_numpy(scene.bounds).float()
    for size in (COARSE, count):
        edge = float((box[1] - box[0]).max()) / size
        axes = [torch.arange(float(box[0, k]) + edge / 2, float(box[1, k]), edge) for k in range(3)]
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        seen, pixels = _projected(points.reshape(-1, 3), cameras)
        inside = torch.stack(
            [s & masks[i][p[:, 1], p[:, 0]] for i, (s, p) in enumerate(zip(seen, pixels, strict=True))]
        )
        inside = inside.all(0).reshape(points.shape[:3])
        if not inside.any():
            raise InputError(f"{scene.path}: spring-gaus: the masks of frame 0 have no common volume")
        if size == count:
            break
        box = torch.stack([points[inside].amin(0) - edge, points[inside].amax(0) + edge])
    return axes, inside


def _count_bodies(inside: Tensor) -> int:
    """Number of connected parts of [X, Y, Z] that hold at least a fiftieth of the voxels."""
    left, count, least = inside.clone(), 0, 0.02 * int(inside.sum())
    while left.any():
        part = torch.zeros_like(left)
        part[tuple(left.nonzero()[0])] = True
        size = 0
        while size < (size := int(part.sum())):
            part = (F.max_pool3d(part[None, None].float(), 3, 1, 1)[0, 0] > 0) & left
        count, left = count + (size >= least), left & ~part
    return count


def _projected(points: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Whether each camera sees each of [P, 3] points, bool [I, P], and in which pixel, int64 [I, P, 2] (x, y)."""
    local = points @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
    depth = local[..., 2:]
    places = (local / depth.clamp_min(1e-6)) @ cameras.Ks.mT
    sizes = torch.tensor([cameras.width, cameras.height], device=points.device)
    pixels = places[..., :2].floor().clamp(-1, 2**20).long()
    seen = (depth[..., 0] > 1e-3) & (pixels >= 0).all(-1) & (pixels < sizes).all(-1)
    return seen, pixels.clamp_min(0).minimum(sizes - 1)


def _seen_colors(points: Tensor, cameras: Cameras, images: Tensor) -> Tensor:
    """Mean colours [P, 3] of the pixels of points, over the images [I, H, W, 3] that show something there."""
    seen, pixels = _projected(points, cameras)
    colors = torch.stack([image[p[:, 1], p[:, 0]] for image, p in zip(images, pixels, strict=True)])
    counted = (seen & (colors.amax(-1) > 0))[..., None]
    return (colors * counted).sum(0) / counted.sum(0).clamp_min(1)
