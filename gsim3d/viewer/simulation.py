"""A scene that a simulator predicts while it is looked at: edits, bodies, and effects with their measured costs."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.data import Scene
from gsim3d.effects.edits import Duplicate, Edit, Move, Operation, Recolor, Remove, Throw, structure_of
from gsim3d.effects.plan import Plan
from gsim3d.effects.selection import Selection, newest_mask
from gsim3d.effects.spec import BACKGROUNDS, CHANGING, POLICIES, EffectsSpec, OutputEffects, Sleep, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.numerics.speed import encode, encode_histories
from gsim3d.numerics.trust import rollout_with_spread
from gsim3d.state import DYNAMIC, Gaussians, Particles, concatenate, last_steps
from gsim3d.train.restore import Restored
from gsim3d.viewer.bodies import SOLID, with_bodies, with_copies
from gsim3d.viewer.live import Target

OPERATIONS = {"move": Move, "throw": Throw, "remove": Remove, "duplicate": Duplicate, "recolor": Recolor}
VECTORS = {"move": "by", "throw": "velocity", "duplicate": "by", "recolor": "color"}
TIMED, ROUNDS = 2, 3  # steps that are timed for each setting, and rounds, of which the fastest counts
PATIENCE = 1.0  # seconds; a setting whose rounds have taken so long is not timed again
MARGIN = 0.03  # of the longest side of a body, around it
HIT, NEAR = 2.0, 0.01  # a ray hits what is nearer to it than so many standard deviations, or such a share of the depth
SEEN = 0.2  # least opacity of what a ray hits
Box = tuple[Sequence[float], Sequence[float]]


@dataclass(frozen=True, eq=False)
class Part:
    """Steps that were predicted in one go."""

    first: int  #: of them, counted from the first predicted one of all
    edits: tuple[Edit, ...]  #: made right before it
    history: Particles  #: steps before it as the model saw them, after the edits
    steps: list[Particles]  #: predicted particles
    plan: Plan  #: by which they were predicted
    seconds: float  #: that a step took


@dataclass(frozen=True)
class Switch:
    """An effect of the plan."""

    name: str  #: as ``gsim3d plan`` has it
    now: str  #: the setting that is chosen
    settings: dict[str, EffectsSpec]  #: setting -> effects with it; one alone where there is no choice
    why: str = ""  #: why other settings are not possible with this model; empty: all are


@dataclass(frozen=True)
class OfBody(Selection):
    """Particles of one body."""

    body: int = 0  #: its number, the ``label`` of its particles

    def mask(self, particles: Particles) -> Tensor:
        chosen = super().mask(particles) & (particles.label == self.body)
        if not bool(chosen[newest_mask(particles)].any()):
            raise InputError("the selection is empty: the box holds nothing of the chosen body")
        return chosen


class Simulation:
    """A scene and the simulator that predicts it, loaded once.

    Attributes:
        target: what it shows: given frames, then predicted ones.
        parts: what was predicted up to now.
        effects: what the next predicted part computes.
        seconds_a_step: that the last prediction took.
        is_closed: whether a prediction in another thread stops after its step.
    """

    def __init__(self, restored: Restored, source: Scene | Particles, n_steps: int | None = None, start: int = 0):
        """
        Args:
            source: a scene that was opened by ``restored``, or the last steps of one, as particles of this model.
            n_steps: to predict; None: to the end of the recording, or 12 of particles.
            start: first input step of a scene.
        Raises:
            InputError: the scene has too few steps or cameras.
        """
        self._simulator, self.seconds_a_step, self.is_closed = restored.simulator, 0.0, False
        self.parts: list[Part] = []
        self._frames: Frames | None = None
        self._spreads: dict[Part, Tensor] = {}
        spec, plan = restored.plan.spec, restored.plan
        fades = "opacity_changes" in plan.on or spec.appearance.opacity_changes
        dynamics = dataclasses.replace(spec.dynamics, history=plan.history)
        appearance = dataclasses.replace(spec.appearance, view_dependent=plan.sh_degree, opacity_changes=fades)
        self.effects = EffectsSpec(dynamics, appearance, spec.structure, OutputEffects())
        about = {"name": "state", "fps": restored.fps or 24.0}
        if isinstance(source, Scene):
            self._frames = source.input_frames(restored.simulator.inputs, start=start)
            with torch.no_grad():
                state = encode(restored.simulator, self._frames, (str(source.path),))
            about = {"name": source.name, "fps": source.fps, "scene": source, "first": start}
            n_steps = n_steps or max(1, source.n_steps - start - state.n_clouds)
        else:
            state = source.to(restored.device)
        self._state, self._sh_degree = with_bodies(state), plan.sh_degree
        offset = state.world_offset
        self._offset = [0.0, 0.0, 0.0] if offset is None else offset[0].tolist()
        given = [self._state.select_clouds([cloud]) for cloud in range(state.n_clouds)]
        bounds = None if self._simulator.trust is None else self._bounds
        self.target = Target(draw=self._draw, particles=given, n_encoded=len(given), bounds=bounds, **about)
        self.simulate_on(len(given) - 1, n_steps or 12)

    @property
    def edits(self) -> tuple[Edit, ...]:
        """Changes of the scene up to now, their steps counted from the first predicted one."""
        return tuple(edit for part in self.parts for edit in part.edits)

    def _draw(self, particles: Particles) -> Gaussians:
        return self._simulator.renderer(particles, sh_degree=self._sh_degree)

    def _part_before(self, step: int) -> Part | None:
        """The one that predicted the step before ``step``; None: it was given."""
        return next((part for part in reversed(self.parts) if part.first < step), None)

    def _bounds(self, frame: int) -> Tensor:
        """Bounds of the errors of a frame's particles, [N] metres on the CPU."""
        step, particles = frame - self.target.n_encoded, self.target.particles[frame]
        part = self._part_before(step + 1)
        if part is None:
            return torch.zeros(particles.n_rows)
        bounds = self._simulator.trust.bound(self.spread(part), first=part.first + 1)[step - part.first]
        return torch.where(particles.activity.cpu() == DYNAMIC, bounds, 0).float()

    @torch.no_grad()
    def spread(self, part: Part) -> Tensor:
        """Spread of the particles over variants of a part, [S, N] metres on the CPU; predicts them the first time. Its
        variants start from the prediction, so the spread that those of the part before have reached is added."""
        if part not in self._spreads:
            histories = [part.history]
            if part.first == 0 and not part.edits and self._frames is not None:
                histories = encode_histories(self._simulator, self._frames)
            spread = rollout_with_spread(self._simulator, histories, len(part.steps), part.plan)[1].cpu()
            if (before := self._part_before(part.first)) is not None:
                reached = self.spread(before)[part.first - before.first - 1]
                spread += reached if len(reached) == spread.shape[1] else reached.amax()  # other particles after edits
            self._spreads[part] = spread
        return self._spreads[part]

    def _step_after(self, frame: int) -> int:
        step, n_given = frame + 1 - self.target.n_encoded, self.target.n_encoded
        if not 0 <= step <= self.target.n_frames - n_given:
            raise InputError(f"simulate on: frame {frame} must be from {n_given - 1} to {self.target.n_frames - 1}")
        return step

    def _history(self, step: int) -> Particles:
        """Steps before ``step``, as the model saw or made them."""
        part = self._part_before(step)
        if part is None:
            return self._state
        known = concatenate([part.history, *part.steps[: step - part.first]])
        return last_steps(known, 2**self._simulator.config.dynamics.history_bits)

    def _timed(self, history: Particles, n_steps: int, plan: Plan) -> tuple[list[Particles], Plan, float]:
        """Predicted steps, their plan, and the seconds that one and its Gaussians took."""
        began = time.perf_counter()
        steps = self._simulator.rollout(history, n_steps, plan, wrap=lambda predict: partial(self._called, predict))
        for particles in steps:
            drawn = self._simulator.renderer(particles, sh_degree=plan.sh_degree)
        drawn.means.sum().item()  # waits for the device
        return steps, plan, (time.perf_counter() - began) / n_steps

    def _called(self, predict: Callable, *given: Any, **options: Any) -> Particles:
        if self.is_closed:
            raise InputError("simulate on: the viewer was closed")
        return predict(*given, **options)

    def simulate_on(self, frame: int, n_steps: int, operations: Sequence[Operation] = ()) -> None:
        """Predicts the frames after ``frame`` anew, with the effects that are on; earlier edits stay, later ones go.

        The scene changes by ``operations`` right after ``frame``.

        Raises:
            InputError: nothing changes: an operation cannot be made, or ``frame`` is not the last given or predicted.
        """
        self.take(self.predicted(frame, n_steps, operations, self.effects))

    @torch.no_grad()
    def predicted(self, frame: int, n_steps: int, operations: Sequence[Operation], effects: EffectsSpec) -> Part:
        """What :meth:`simulate_on` then shows by :meth:`take`; changes nothing. Raises what it raises."""
        step = self._step_after(frame)
        if n_steps < 1:
            raise InputError(f"simulate on: steps must be at least 1; got {n_steps}")
        edits = tuple(Edit(step, one) for one in operations)
        plan = self._simulator.plan(dataclasses.replace(effects, structure=structure_of(edits)))
        history = self._simulator._prepare(self._history(step), plan)
        for edit in edits:
            counts = history.clouds.counts
            history = edit.apply(history, self._simulator._colors)
            history = with_copies(history, counts) if edit.operation.inserts else history
        history = self._simulator.dynamics.initialize(history) if edits else history
        return Part(step, edits, history, *self._timed(history, n_steps, plan))

    def take(self, part: Part) -> None:
        """Shows a predicted part instead of the frames from its first one on."""
        self.parts = [one for one in self.parts if one.first < part.first] + [part]
        self._spreads = {one: spread for one, spread in self._spreads.items() if one in self.parts}
        self._sh_degree, self.seconds_a_step = part.plan.sh_degree, part.seconds
        self.target.replace([*self.target.particles[: part.first + self.target.n_encoded], *part.steps])

    def operations(self, frame: int, more: Operation | None) -> list[Operation]:
        """Those right after ``frame`` and ``more``, in place of one of its kind on the same particles; None: none."""
        made = [edit.operation for edit in self.edits if edit.step == self._step_after(frame)]
        return [one for one in made if (type(one), one.of) != (type(more), more.of)] + [more] if more else []

    def operation(
        self, name: str, which: str, vector: Sequence[float], box: Box | None = None, body: int | None = None
    ) -> Operation:
        """The operation that a user chose.

        Args:
            name: one of OPERATIONS.
            which: particles, as of :class:`gsim3d.effects.selection.Selection`.
            vector: metres of a move or a copy, metres a step of a throw, or a colour.
            box: lowest and highest corner, in the axes of the viewer; None: everywhere.
            body: number of the only body that is meant; None: any.
        Raises:
            InputError: there is no such operation or selection.
        """
        if name not in OPERATIONS:
            raise InputError(f"operation must be one of {', '.join(OPERATIONS)}; got {name!r}")
        moved = (zip(corner, self._offset, strict=True) for corner in box or ())
        corners = tuple(tuple(float(x) + o for x, o in corner) for corner in moved) or None
        fields = {VECTORS[name]: tuple(float(x) for x in vector)} if name in VECTORS else {}
        of = Selection(which, corners) if body is None else OfBody(which, corners, body)
        return OPERATIONS[name](of, **fields)

    def bodies(self, frame: int) -> dict[int, Tensor]:
        """Number of each body of a frame -> rows of its particles, int64."""
        label = self.target.particles[frame].label
        return {body: (label == body).nonzero()[:, 0] for body in label.unique().tolist() if body >= 0}

    def box_of(self, frame: int, body: int) -> Box:
        """Lowest and highest corner of a body of ``frame``, also in the steps that the model goes on from after it."""
        known = self.target.particles[frame]
        if frame >= self.target.n_encoded - 1:
            known = last_steps(self._history(self._step_after(frame)), self.effects.dynamics.history)
        chosen = known.label == body
        solid = chosen & (known.opacities > SOLID)
        points = known.means[solid if bool(solid.any()) else chosen]
        low, high = points.amin(0), points.amax(0)
        margin = MARGIN * (high - low).max().clamp(min=1e-3)
        return (low - margin).tolist(), (high + margin).tolist()

    def switches(self) -> list[Switch]:
        """Every effect of the plan with the settings that this model has; those without a choice say why."""
        made = [self._switch(name, group, field, values) for name, (group, field, values) in self._choices().items()]
        priors = ", ".join(self._simulator.plan(self.effects).priors) or "none"
        made.append(Switch("insert, remove", "by edits", {"by edits": self.effects}, "on where edits need them"))
        why = "trained together with the weights: another model is needed"
        return [*made, Switch("priors", priors, {priors: self.effects}, why)]

    def _choices(self) -> dict[str, tuple[str, str, dict]]:
        """Effect -> group and field of a spec, and setting -> value."""
        sleep = self.effects.dynamics.sleep or Sleep()
        powers = {2**bits for bits in range(self._simulator.config.dynamics.history_bits + 1)}
        history = sorted(powers | {self.effects.dynamics.history})
        sleeps = {policy: dataclasses.replace(sleep, policy=policy) for policy in POLICIES}
        return {
            "history": ("dynamics", "history", {f"{n} step{'s' * (n > 1)}": n for n in history}),
            "background": ("dynamics", "background", {name: name for name in BACKGROUNDS}),
            "sleep": ("dynamics", "sleep", {"off": None, **sleeps}),
            "view_dependent": ("appearance", "view_dependent", {f"degree {n}" if n else "off": n for n in range(4)}),
            "changing": ("appearance", "changing", {name: name for name in CHANGING}),
            "opacity_changes": ("appearance", "opacity_changes", {"off": False, "on": True}),
        }

    def _switch(self, name: str, group: str, field: str, values: dict) -> Switch:
        settings, refused, mine = {}, {}, getattr(self.effects, group)
        for label, value in values.items():
            spec = dataclasses.replace(self.effects, **{group: dataclasses.replace(mine, **{field: value})})
            try:
                self._simulator.plan(spec)
            except UnsupportedEffect as error:
                refused[label] = str(error).partition(": ")[2].partition("; ")[0]
                continue
            settings[label] = spec
        value = getattr(mine, field)
        now = next((label for label in settings if values[label] == value), next(iter(settings)))
        return Switch(name, now, settings, "; ".join(f"{label}: {why}" for label, why in refused.items()))

    def choose(self, name: str, setting: str) -> None:
        """Switches an effect for the next predicted part. Raises InputError where there is no such setting."""
        known = next((switch.settings for switch in self.switches() if switch.name == name), {})
        if setting not in known:
            raise InputError(f"effect {name}: {setting!r} is not possible; it has {', '.join(known) or 'no settings'}")
        self.effects = known[setting]

    @torch.no_grad()
    def costs(self, frame: int, progress: Callable[[float], object] = float) -> list[tuple[str, str, float]]:
        """Effect, setting and milliseconds of a step after ``frame`` on this machine, other effects as they are now."""
        history = self._history(self._step_after(max(frame, self.target.n_encoded - 1)))
        switches = [switch for switch in self.switches() if len(switch.settings) > 1]
        specs = {spec.hash: spec for switch in switches for spec in switch.settings.values()}
        found: dict[str, float] = {}
        for digest, spec in specs.items():
            progress(len(found) / len(specs))
            plan, times = self._simulator.plan(spec), []
            while len(times) < ROUNDS and TIMED * sum(times) < PATIENCE:
                times.append(self._timed(history, TIMED, plan)[2])
            found[digest] = 1000 * min(times)
        progress(1.0)
        return [(one.name, label, found[spec.hash]) for one in switches for label, spec in one.settings.items()]


def hit(gaussians: Gaussians, rows: Tensor, origin: Sequence[float], direction: Sequence[float]) -> int | None:
    """The row of the nearest of the ``rows`` (bool [N]) that a ray hits; None where it hits nothing."""
    ray = torch.nn.functional.normalize(gaussians.means.new_tensor(direction), dim=0)
    offset = gaussians.means - gaussians.means.new_tensor(origin)
    depth = offset @ ray
    apart = (offset - depth[:, None] * ray).norm(dim=1)
    reach = torch.maximum(HIT * gaussians.scales.amax(1), NEAR * depth)
    hits = rows & (depth > 0) & (apart < reach) & (gaussians.opacities > SEEN)
    score = torch.where(hits, depth + apart, torch.inf)
    return int(score.argmin()) if bool(hits.any()) else None
