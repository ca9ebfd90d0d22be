"""Scenes of environments in a learned simulator: encoded from images of the truth, moved by kinematic particles."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames, InputSpec
from gsim3d.dynamics import FrozenContext
from gsim3d.dynamics.frozen_context import Reader
from gsim3d.effects.actors import Actor
from gsim3d.effects.selection import Selection, newest_mask
from gsim3d.envs.scenes import FPS, N_PARTICLES, Scenes, TrueScene, task_rig
from gsim3d.errors import InputError
from gsim3d.nn.multiview_encoder import pixel_rows
from gsim3d.ops.curve import Pyramid
from gsim3d.simulator import Simulator
from gsim3d.state import (
    DYNAMIC,
    FROZEN,
    Actions,
    CloudTable,
    Particles,
    append_step,
    concatenate,
    last_steps,
    newest_clouds,
    with_velocity,
)
from gsim3d.synth import cameras, render
from gsim3d.synth.scene_setup import GRAVITY


@dataclass(frozen=True)
class ActorRows(Selection):
    """The particles whose attribute ``actor`` is ``number``."""

    number: int = 0  #: of the actor

    def mask(self, particles: Particles) -> Tensor:
        return particles.actor == self.number


@dataclass(frozen=True)
class ModelState:
    """State of :class:`ModelScenes`."""

    particles: Particles  #: last steps of every scene; ``actor`` marks the particles of actors
    actors: Tensor  #: float64 [n, L, A, 3] metres, centers of the actors in the last L steps


@dataclass(frozen=True)
class Start:
    """Images that a scene is encoded from."""

    views: Sequence[render.View]  #: of the last steps, the newest last
    actors: np.ndarray  #: [L, A, 3] metres, centers of the actors in these steps
    scene: TrueScene  #: whose bodies these are; its positions are not read
    #: centers of the bodies now [B, 3] in metres. Default: the middles of the boxes around their particles.
    centers: np.ndarray | None = None


class ModelScenes(Scenes):
    """Scenes side by side in one learned simulator, in one batch.

    Particles of actors move as given. A model with action particles of the scenes' ``actor_type`` also has the actors'
    points in its input; for others, the particles are kinematic (:class:`gsim3d.effects.actors.Actor`). Centers of
    bodies follow the rigid motion that fits their points best.

    Args:
        simulator: trained at 12 frames a second, or at an unknown rate.
        count: number of scenes, n.
        most_bodies: largest number of bodies of a scene, B.
        image_size: pixels of the input images, where the simulator does not know its own.

    Attributes:
        simulator: of all scenes.
        plan: its default, without sleep.
        rig: cameras of the input images.
        history: number of steps that a scene is encoded from.
        state: of all scenes; None before the first :meth:`reset`. May be replaced by another one of the same scenes.

    Raises:
        InputError: the simulator has another frame rate, or images that are not square.
    """

    def __init__(self, simulator: Simulator, count: int, most_bodies: int, image_size: int = 64):
        inputs = simulator.inputs or InputSpec(history=0)
        if inputs.fps not in (None, FPS):
            raise InputError(f"model was trained at {inputs.fps:g} frames a second; environments have {FPS}")
        sizes = set(inputs.image_size) or {image_size}
        if len(sizes) > 1:
            raise InputError(f"model has images of {inputs.image_size} pixels; environments have square ones")
        awake = dataclasses.replace(simulator.effects.dynamics, sleep=None)
        self.plan = simulator.plan(dataclasses.replace(simulator.effects, dynamics=awake))
        self.simulator, self.count, self.most_bodies = simulator, count, most_bodies
        self.inputs, self.history = inputs, inputs.history or self.plan.history
        self.rig = task_rig(sizes.pop(), inputs.context_views)
        self.device = next(simulator.parameters()).device
        self.state: ModelState | None = None
        self._type, self._wrap = "", None

    def reset(self, started: Mapping[int, TrueScene], rngs: Mapping[int, np.random.Generator]) -> None:
        starts = {}
        for number, scene in started.items():
            actors = np.stack([scene.actors] * self.history)
            starts[number] = Start([scene.view(self.rig)] * self.history, actors, scene, scene.centers)
        self.encode(starts, rngs)

    @torch.no_grad()
    def encode(self, started: Mapping[int, Start], rngs: Mapping[int, np.random.Generator]) -> None:
        """Replaces scenes, by their numbers; ``rngs`` choose their points.

        Raises:
            InputError: no camera sees a body.
        """
        started = dict(sorted(started.items()))
        frames, labels = self._frames(started)
        particles = self.simulator.encode(frames)
        label = pixel_rows(frames, labels)
        n_bodies = torch.tensor([start.scene.n_bodies for start in started.values()], device=self.device)
        n_bodies = n_bodies.repeat_interleave(self.history)[particles.row_cloud()]
        actor = torch.where(label >= n_bodies, label - n_bodies, -1)
        particles = dataclasses.replace(particles, actor=self._gripped(particles, actor, started))
        if self.simulator.dynamics.priors.get("segmentation") is not None:
            particles = dataclasses.replace(particles, body=_body_centers(particles, label))
        if self.plan.spec.dynamics.background == "masked_out":
            particles, label = particles.select_rows(label >= 0), label[label >= 0]
        of_newest = label[newest_mask(particles)]
        self._merge(particles, started)
        labels = of_newest.split([particles.clouds.count(q) for q in newest_clouds(particles.clouds)])
        for (number, start), of_scene in zip(started.items(), labels, strict=True):
            self._choose(number, start, of_scene, rngs[number])

    def move(self, velocities: Tensor) -> None:  # gradients flow to velocities
        before, actors = self.state.particles, self.state.actors
        moved = velocities / FPS
        path = torch.cat([actors, actors[:, -1:] + moved[:, None]], 1)
        if self._type in self.plan.spec.dynamics.actions:
            step = self._acted(before, path)
            newest, known = last_steps(before, 1).means, step.actor.clamp_min(0)
            means = newest + moved[step.row_scene(), known].float()
            step = dataclasses.replace(step, means=torch.where((step.actor >= 0)[:, None], means, step.means))
        else:
            acting = [Actor(one[:, None], ActorRows(number=number)) for number, one in enumerate(moved.unbind(1))]
            step = self.simulator.rollout(before, 1, self.plan, actors=acting, wrap=self._wrap)[0]
        self.state = ModelState(self._reduced(append_step(before, step, self.plan.history)), path[:, 1:])

    def _acted(self, before: Particles, path: Tensor) -> Particles:
        """The step that follows with the points of actors whose centers are on ``path`` [n, L + 1, A, 3]."""
        path = (path[:, :, :, None] + self._offsets).flatten(2, 3)
        first = tuple(before.clouds.steps[q] + 2 - path.shape[1] for q in newest_clouds(before.clouds))
        types = torch.zeros(path.shape[:3], dtype=torch.int64, device=self.device)
        acting = dataclasses.replace(before, actions=Actions(path.float(), types, (self._type,), first))
        return dataclasses.replace(self.simulator.rollout(acting, 1, self.plan, wrap=self._wrap)[0], actions=None)

    @torch.no_grad()
    def repeated(self, state: ModelState, count: int, reach: float | None = None) -> ModelScenes:
        """``count`` copies of one scene in ``state``, for predictions with different actions.

        A background that the model computes once a rollout (``background="asymmetric"``) is shared by all copies, and
        only moving particles are copied. Other models have the background in the input of every step, so that it is
        copied, too; ``reach`` limits it.

        Args:
            state: of one scene.
            count: number of copies.
            reach: metres; copies lack the background that is farther, along the ground, from all moving particles.
                Default: they have all of it.

        Raises:
            InputError: these are several scenes.
        """
        if self.count != 1 or state is None:
            raise InputError(f"one scene can be repeated, after its reset; got {self.count}")
        copies, particles = copy.copy(self), state.particles
        newest, frozen = last_steps(particles, 1), particles.activity == FROZEN
        kept = torch.ones_like(frozen)
        if self.simulator.config.dynamics.is_asymmetric:
            static = self.simulator.dynamics.remember(newest.select_rows(newest.activity == FROZEN))
            shared, kept = SharedContext(**vars(static)), ~frozen
            copies._wrap = lambda predict: lambda history, background, **options: predict(history, shared, **options)
        elif reach is not None:
            moving = newest.means[newest.activity != FROZEN, :2]
            kept[frozen] = torch.cdist(particles.means[frozen, :2], moving).amin(1) <= reach
        copies._rows = kept[newest_mask(particles)].cumsum(0)[self._rows] - 1
        particles = particles.select_rows(kept)
        copies.count, copies.state = count, ModelState(tiled(particles, count), state.actors.expand(count, -1, -1, -1))
        for name in ("_rows", "_members", "_rest", "_centers"):
            value = getattr(copies, name)
            setattr(copies, name, value.expand(count, *value.shape[1:]))
        return copies

    @torch.no_grad()
    def throw(self, velocities: Tensor) -> None:
        """The older steps of the history become those of a free flight that has ``velocities`` now."""
        particles = self.state.particles
        table, scene = particles.clouds, particles.row_scene()
        newest = {table.scenes[q]: table.steps[q] for q in newest_clouds(table)}
        ages = [newest[scene] - step for scene, step in zip(table.scenes, table.steps)]
        seconds = torch.tensor(ages, device=self.device)[particles.row_cloud(), None] / FPS
        fall = 0.5 * torch.tensor([0.0, 0.0, -GRAVITY], device=self.device)
        moves = (particles.activity == DYNAMIC)[:, None]
        velocity = velocities.float()[scene]
        means = particles.means + torch.where(moves, seconds * (fall * seconds - velocity), 0)
        particles = with_velocity(dataclasses.replace(particles, means=means), moves, (velocity - fall / FPS) / FPS)
        self.state = dataclasses.replace(self.state, particles=particles)

    def actors(self) -> Tensor:
        return self.state.actors[:, -1]

    def centers(self) -> Tensor:
        points, weights = self.points().double(), self._members / self._members.sum(-1, keepdim=True).clamp_min(1)
        before, after = _product(weights, self._rest), _product(weights, points)
        arms = points[:, None] - after[:, :, None], self._rest[:, None] - before[:, :, None]
        u, _, vh = torch.linalg.svd(_product(weights[:, :, None] * arms[0].mT, arms[1]))
        mirrored = torch.linalg.det(_product(u, vh))[..., None, None]
        turn = _product(torch.cat([u[..., :2], u[..., 2:] * mirrored], -1), vh)
        return after + _product(turn, (self._centers - before)[..., None])[..., 0]

    def points(self) -> Tensor:
        newest = last_steps(self.state.particles, 1)
        return newest.means[newest.cu_rows[:-1, None] + self._rows]

    @torch.no_grad()
    def images(self, rig: cameras.Rig) -> Tensor:
        return (255 * self.colors(rig).clamp(0, 1) + 0.5).to(torch.uint8)

    def colors(self, rig: cameras.Rig) -> Tensor:
        """Images of the cameras of ``rig``, float [n, V, H, W, 3]; differentiable. Copies lack a shared background."""
        newest, shown = last_steps(self.state.particles, 1), torch.arange(self.count, device=self.device)
        views = _cameras(rig, shown.repeat_interleave(rig.n_cams))
        return self.simulator.render(newest, views, plan=self.plan).color.unflatten(0, (self.count, rig.n_cams))

    def _frames(self, started: Mapping[int, Start]) -> tuple[Frames, Tensor]:
        """Input frames, and the label of each pixel: a body, then an actor, else negative."""
        views = [view for start in started.values() for view in start.views]
        images, segments, labels = (
            torch.from_numpy(np.concatenate([getattr(view, name) for view in views])).to(self.device)
            for name in ("rgb", "segmentation", "instances")
        )
        frames = Frames(
            images=images.permute(0, 3, 1, 2).float().div_(255),
            cameras=_cameras(self.rig, torch.arange(len(views), device=self.device).repeat_interleave(self.rig.n_cams)),
            cloud_scene=torch.tensor(list(started), device=self.device).repeat_interleave(self.history),
            cloud_step=torch.arange(self.history, device=self.device).repeat(len(started)),
            origin=torch.from_numpy(cameras.workspace_origin(self.rig)).to(self.device).expand(self.count, 3),
            masks=segments != render.BACKGROUND,
            dynamic=segments == render.BODY,
        )
        labels = torch.where(frames.dynamic, labels.long() - render.FIRST_BODY, -1)
        return frames.subsample(self.inputs.background_stride, self.inputs.body_stride, self.inputs.masks), labels

    def _gripped(self, particles: Particles, actor: Tensor, started: Mapping[int, Start]) -> Tensor:
        """Actor of each particle [N]; those of bodies in a gripper belong to it."""
        for number, start in started.items():
            for a, center in enumerate(start.actors[-1] if start.scene.grip else ()):
                away = particles.means - torch.from_numpy(center).to(particles.means)
                held = (away.norm(dim=1) < start.scene.grip) & (particles.row_scene() == number)
                actor = torch.where(held & (particles.activity == DYNAMIC), a, actor)
        return actor

    def _reduced(self, particles: Particles) -> Particles:
        """``particles`` without those that the network does not see: the older background of a relightable model."""
        if not self.simulator.config.dynamics.is_relightable:
            return particles
        return particles.select_rows((particles.activity != FROZEN) | newest_mask(particles))

    def _merge(self, particles: Particles, started: Mapping[int, Start]) -> None:
        """Replaces the scenes ``started`` of the state by ``particles``."""
        particles, length = self._reduced(particles), self.plan.history
        if self.state is None or len(started) == self.count:
            self._rows = torch.zeros(self.count, N_PARTICLES, dtype=torch.int64, device=self.device)
            self._rest = torch.zeros(self.count, N_PARTICLES, 3, dtype=torch.float64, device=self.device)
            self._members = torch.zeros(self.count, self.most_bodies, N_PARTICLES, device=self.device).double()
            self._centers = torch.full((self.count, self.most_bodies, 3), torch.nan, device=self.device).double()
            one = next(iter(started.values()))
            positions = torch.zeros(self.count, length, *one.actors.shape[1:], device=self.device).double()
            self._type, self._offsets = one.scene.actor_type, torch.from_numpy(one.scene.actor_points).to(self.device)
        else:
            old, positions = self.state.particles, self.state.actors.clone()
            kept = old.select_clouds([q for q, scene in enumerate(old.clouds.scenes) if scene not in started])
            particles = concatenate([kept, particles])
        for number, start in started.items():
            before = [start.actors[:1]] * max(0, length - len(start.actors))
            positions[number] = torch.from_numpy(np.concatenate([*before, start.actors])[-length:]).to(self.device)
        self.state = ModelState(particles, positions)

    def _choose(self, number: int, start: Start, labels: Tensor, rng: np.random.Generator) -> None:
        """Chooses the points of a scene, an equal share of each body; ``labels`` are of its newest particles."""
        n_bodies, means = start.scene.n_bodies, last_steps(self.state.particles, 1)
        share = -(-N_PARTICLES // n_bodies)
        means = means.means[means.cu_rows[number] : means.cu_rows[number + 1]]
        rows, middles = [], []
        for body in range(n_bodies):
            known = (labels == body).nonzero()[:, 0]
            if not len(known):
                raise InputError(f"body {body} of scene {number} is not seen by any camera; reset with another seed")
            rows.append(known[torch.from_numpy(rng.integers(len(known), size=share)).to(self.device)])
            middles.append((means[known].amin(0) + means[known].amax(0)) / 2)
        self._rows[number] = torch.cat(rows)[:N_PARTICLES]
        self._rest[number] = means[self._rows[number]].double()
        of_points = torch.arange(N_PARTICLES, device=self.device) // share
        self._members[number] = of_points == torch.arange(self.most_bodies, device=self.device)[:, None]
        centers = torch.stack(middles).double() if start.centers is None else torch.from_numpy(start.centers)
        self._centers[number, :n_bodies], self._centers[number, n_bodies:] = centers.to(self.device), torch.nan


class SharedContext(FrozenContext):
    """A static background of scene 0 that all scenes read."""

    def readers(self, pyramid: Pyramid, particles: Particles) -> list[Reader]:
        first = torch.zeros_like(particles.cloud_scene)
        return super().readers(pyramid, dataclasses.replace(particles, cloud_scene=first))


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Matrix products whose bits do not depend on the size of the batch."""
    return (a[..., None] * b[..., None, :, :]).sum(-2)


def tiled(particles: Particles, count: int) -> Particles:
    """``count`` copies of one scene, scenes 0 to ``count - 1`` of the result, to be predicted with different actions.

    Args:
        particles: state of one scene.
        count: number of copies.

    Raises:
        InputError: ``particles`` has several scenes.
    """
    table = particles.clouds
    if len(set(table.scenes)) != 1:
        raise InputError(f"particles must have one scene; got {len(set(table.scenes))}")
    of = [table.scenes[0]] * count
    scenes, steps = [number for number in range(count) for _ in table.scenes], table.steps * count
    made = CloudTable.make(table.counts * count, scenes, steps, particles.cu_rows.device)
    fields = {name: torch.cat([value] * count) for name, value in particles.row_fields().items()}
    fields["world_offset"] = None if particles.world_offset is None else particles.world_offset[of]
    fields["actions"] = particles.actions and particles.actions.select(of)
    return particles.with_clouds(made, origin=particles.origin[of], **fields)


def _cameras(rig: cameras.Rig, image_cloud: Tensor) -> Cameras:
    """Cameras of a rig for each of several clouds; ``image_cloud`` [I] is the cloud of every image."""
    viewmats, Ks = (torch.from_numpy(x).float().to(image_cloud.device) for x in (rig.viewmats, rig.Ks))
    copies = len(image_cloud) // rig.n_cams
    depths = (torch.full((len(image_cloud),), depth, device=image_cloud.device) for depth in (rig.near, rig.far))
    return Cameras(viewmats.repeat(copies, 1, 1), Ks.repeat(copies, 1, 1), *depths, image_cloud, rig.size, rig.size)


def _body_centers(particles: Particles, label: Tensor) -> Tensor:
    """Mean position of the particles of the same label in the same cloud [N, 3]; the own position without a label."""
    most = int(label.max()) + 1
    of = particles.row_cloud() * (most + 1) + torch.where(label < 0, most, label)
    points = torch.nn.functional.pad(particles.means.double(), (0, 1), value=1.0)
    sums = points.new_zeros(particles.n_clouds * (most + 1), 4).index_add_(0, of, points)
    means = (sums[:, :3] / sums[:, 3:]).to(particles.means)
    return torch.where((label >= 0)[:, None], means[of], particles.means)
