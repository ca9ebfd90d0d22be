"""Spring-Gaus: an elastic object fitted to one trajectory, as a baseline of ``gsim3d evaluate``.

Isotropic Gaussians are fitted to frame 0, bound to a spring-mass system, and its initial velocity, stiffness, friction
and softness to the first frames by rendering. What is not as published: Gaussians begin in the visual hull of the masks
instead of a box, and are not densified; a ground of flat Gaussians at a known height is fitted beside the object.

Source: Zhong et al. 2024, "Reconstruction and Simulation of Elastic Objects with Spring-Mass 3D Gaussians".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.baselines.spring_mass import (
    Springs,
    SpringState,
    advance_safely,
    bind,
    build_springs,
    friction,
    softness,
)
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
    static_iterations: int = 3000  #: of Adam on frame 0
    refine_iterations: int = 1000  #: of appearance with bound positions, before each of the two next stages
    velocity_iterations: int = 100  #: passes through the frames before contact
    dynamic_iterations: int = 300  #: passes through all fitted frames
    hit_frame: int = 4  #: frames of the velocity stage
    ground: float = 0.0  #: metres, height of the ground along z
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

    def cameras(self, scene: Scene) -> tuple[int, ...]:
        """Returns every fourth camera: the others are fitted."""
        return tuple(range(0, scene.n_cams, 4))

    def check(self, scene: Scene, cams: Sequence[int], n_encoded: int, n_future: int) -> None:
        """Raises InputError where the method does not apply: no labels, no ground, or more than one body."""
        if not scene.has_segmentation():
            raise InputError(f"{scene.path}: {self.name} is not applicable: the scene has no masks of the object")
        others = [cam for cam in range(scene.n_cams) if cam not in cams]
        if len(others) < 2:
            raise InputError(f"{scene.path}: {self.name} is not applicable: {len(others)} cameras are left to fit")
        labels = scene.segmentation(others, [0])
        if not (labels == FIXED).any():
            raise InputError(f"{scene.path}: {self.name} is not applicable: there is no ground")
        n_bodies = _count_bodies(_hull(scene, others, COARSE)[1])
        if n_bodies != 1:
            raise InputError(f"{scene.path}: {self.name} is not applicable: {n_bodies} bodies, and it simulates one")

    def images(self, scene: Scene, cams: list[int], n_encoded: int, n_future: int) -> Tensor:
        """Fits the scene; returns ``n_future`` steps after the first ``n_encoded``, uint8 [n_future, V, H, W, 3]."""
        count = self.config.fit_frames
        count = n_encoded if count is None else min(count or scene.n_steps, scene.n_steps)
        fit = Fit(scene, [cam for cam in range(scene.n_cams) if cam not in cams], count, self.config, self.device)
        return fit.images(cams, range(n_encoded, n_encoded + n_future)).mul(255).round().to(torch.uint8)


class Fit:
    """One scene, fitted when it is made.

    Attributes:
        velocity: [3] m/s at frame 0.
        stiffness: log10 of each anchor's, [N].
        losses: losses of the dynamic stage, means over a pass.
        substeps: of a frame, at the end.
    """

    def __init__(self, scene: Scene, cams: Sequence[int], count: int, config: SpringGausConfig, device: torch.device):
        self.scene, self.config, self.device, self.count = scene, config, device, count
        self._generator = torch.Generator().manual_seed(config.seed)
        self._cameras = [scene.cameras_at(cams, [step]).to(device) for step in range(count)]
        images = scene.images(cams, range(count)).to(device).permute(0, 1, 3, 4, 2).float() / 255
        labels = scene.segmentation(cams, range(count)).to(device)
        self._objects = images * (labels == MOVING)[..., None]
        axes, inside = _hull(scene, cams, FINE)
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)[inside].to(device)
        cell = float(axes[0][1] - axes[0][0])
        self.object = Splats(points, _seen_colors(points, self._cameras[0], self._objects[0]), cell / 2)
        self.ground = self._fit_ground(images[0] * (labels[0] != MOVING)[..., None], labels[0] != MOVING)
        self._fit_appearance(config.static_iterations, 0.2, RATES, points)
        rest = self.object.rows["means"].detach()
        options = {"n_anchors": config.anchors, "n_neighbors": config.neighbors, "edge": config.edge}
        self.springs: Springs = build_springs(rest, **options, seed=config.seed)
        self._indices, self._weights = bind(rest, self.springs.rest)
        self._offset = rest - self._bound(self.springs.rest)
        n, k = self.springs.neighbors.shape
        self.velocity = torch.zeros(3, device=device, requires_grad=True)
        self.stiffness = torch.full((n,), config.stiffness, device=device).log10().requires_grad_()
        self._friction = torch.tensor(-1.0, device=device, requires_grad=True)
        self._softness = torch.zeros((), device=device, requires_grad=True)
        self.losses: list[float] = []
        self.substeps = config.substeps
        self._fit_motion()

    def _bound(self, anchors: Tensor) -> Tensor:
        return (self._weights[..., None] * anchors[self._indices]).sum(1)

    def _loss(self, frame: int, means: Tensor, share: float) -> Tensor:
        """(1 - share) L1 + share (1 - SSIM) of one random camera."""
        camera = int(torch.randint(len(self._objects[frame]), (), generator=self._generator))
        image = self.object.render(self._cameras[frame].select(torch.tensor([camera], device=self.device)), means)
        target = self._objects[frame][camera : camera + 1]
        similar = ssim(image.clamp(0, 1), target).mean().float()
        return (1 - share) * (image - target).abs().mean() + share * (1 - similar)

    def _fit_ground(self, images: Tensor, counted: Tensor) -> Splats:
        """Flat Gaussians on the ground, fitted to what is not the object in frame 0."""
        low, high = torch.from_numpy(self.scene.bounds).float()
        axes = [torch.linspace(float(low[k]), float(high[k]), GROUND) for k in range(2)]
        points = torch.cartesian_prod(*axes)
        points = torch.cat([points, torch.full((len(points), 1), self.config.ground)], 1).to(self.device)
        edge = float((high - low)[:2].max() / (GROUND - 1))
        ground = Splats(points, _seen_colors(points, self._cameras[0], images), edge / 2, opacity=2.0)
        adam = ground.optimizer({name: RATES[name] for name in ("colors", "opacities", "scales")})
        for _ in range(self.config.static_iterations // 3):
            loss = ((ground.render(self._cameras[0]) - images).abs().mean(-1) * counted).mean()
            _step(adam, loss)
        return ground

    def _fit_appearance(self, iterations: int, share: float, rates: dict[str, float], means: Tensor | None = None):
        """Adam on frame 0, with the positions too where ``means`` is None or free."""
        adam = self.object.optimizer(rates)
        decay = (LATE_MEANS / RATES["means"]) ** (1 / max(1, iterations))
        for _ in range(iterations):
            place = self.object.rows["means"] if "means" in rates else means
            _step(adam, self._loss(0, place, share))
            adam.param_groups[0]["lr"] *= decay if "means" in rates else 1.0

    def _fit_motion(self) -> None:
        config, appearance = self.config, {name: RATES[name] for name in ("colors", "opacities", "scales")}
        at_rest = self.object.rows["means"].detach()
        self._fit_appearance(config.refine_iterations, 0.2, appearance, at_rest)
        adam = torch.optim.Adam([self.velocity], lr=1e-3, **ADAM)
        halve = torch.optim.lr_scheduler.StepLR(adam, 100, 0.5)
        with progress(None, "velocity", config.velocity_iterations, unit="pass") as bar:
            for _ in range(config.velocity_iterations):
                self._pass(min(config.hit_frame, self.count), 0.2, adam, halve, damping=0.0, soft=False, moved=True)
                bar.update()
        self.velocity = self.velocity.detach()
        bound = self._bound(self.springs.rest)
        self._fit_appearance(config.refine_iterations, 0.05, appearance, bound)
        parts = [self.stiffness, self._friction, self._softness]
        adam, late = torch.optim.Adam(parts, lr=1e-3, **ADAM), self.object.optimizer(appearance)
        with progress(None, "dynamics", config.dynamic_iterations, unit="pass") as bar:
            for number in range(config.dynamic_iterations):
                if number and number in (config.dynamic_iterations // 3, 2 * config.dynamic_iterations // 3):
                    self.substeps += config.more_substeps
                self.losses.append(self._pass(self.count, 0.05, adam, None, damping=config.damping))
                _step(late, self._loss(0, bound, 0.05))
                bar.update()

    def _pass(self, count, share, adam, schedule, *, damping: float, soft: bool = True, moved: bool = False) -> float:
        """Returns the mean loss of frames 1 to ``count - 1``, with a step of Adam each; gradients end at the frame."""
        state, total = SpringState(self.springs.rest, torch.zeros_like(self.springs.rest)), 0.0
        parameters = [p for group in adam.param_groups for p in group["params"]]
        for frame in range(1, count):
            state = self._advance(frame, state, damping, soft)
            means = self._bound(state.positions) + (self._offset if moved else 0)  # moved from where they began
            loss = self._loss(frame, means, share)
            adam.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            adam.step()
            if schedule is not None:
                schedule.step()
            state, total = SpringState(*(part.detach() for part in state)), total + float(loss.detach())
        return total / max(1, count - 1)

    def _advance(self, frame: int, state: SpringState, damping: float, soft: bool) -> SpringState:
        k = self.springs.neighbors.shape[1]
        factors = softness(self._softness, k) if soft else torch.ones(k, device=self.device)
        started = SpringState(state.positions, state.velocities + self.velocity)
        given = {"stiffness": 10**self.stiffness, "factors": factors, "grip": friction(self._friction)}
        given |= {"seconds": 1 / self.scene.fps, "ground": self.config.ground, "damping": damping}
        ended, self.substeps = advance_safely(
            frame, self.substeps, self.config.more_substeps, state=started, springs=self.springs, **given
        )
        return SpringState(ended.positions, ended.velocities - self.velocity)

    @torch.no_grad()
    def images(self, cams: Sequence[int], steps: range) -> Tensor:
        """Returns images [S, V, H, W, 3] in [0, 1] of object and ground at ``steps``, from any cameras."""
        state, images = SpringState(self.springs.rest, torch.zeros_like(self.springs.rest)), []
        for step in range(steps[-1] + 1):
            if step:
                state = self._advance(step, state, self.config.damping, soft=True)
            if step in steps:
                cameras = self.scene.cameras_at(cams, [step]).to(self.device)
                images.append(self.object.render(cameras, self._bound(state.positions), self.ground))
        return torch.stack(images).clamp(0, 1)


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
