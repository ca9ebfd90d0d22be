"""Edits of a scene between steps of a rollout: typed operations on particles.

    edits = [Edit(0, Remove("frozen")), Edit(8, Throw((0.0, 0.0, 0.05), of="moving"))]
    plan = simulator.plan(EffectsSpec(structure=StructureEffects(remove=True)))
    steps = simulator.rollout(state, 24, plan, edits=edits)

An operation changes all steps of the history, so that a moved body keeps its velocity. Selections are evaluated in each
step of the history, so a box must contain the body in all of them.
"""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.effects.selection import Selection, Vector, newest_mask
from gsim3d.effects.spec import StructureEffects
from gsim3d.errors import InputError, check_one_of, check_whole, naming
from gsim3d.io.files import read_yaml, shown
from gsim3d.io.settings import from_dict
from gsim3d.math.rotations import quat_product, rotate_left, rotation_matrices
from gsim3d.math.spherical_harmonics import painted, rotate_harmonics
from gsim3d.state import ATTRIBUTES, FROZEN, VELOCITIES, Particles, joined_clouds, newest_clouds, with_attribute

Colors = Callable[[Particles], Tensor]  # particles -> [N, 3] colours

GREY = (0.2126, 0.7152, 0.0722)  # luminance of red, green and blue
DARKEST = 0.05  # smallest mean luminance that a recolouring divides by


@dataclass(frozen=True)
class Operation:
    """Base class of operations on particles.

    Attributes:
        of: selected particles, a Selection or its ``which``.
    """

    of: Selection | str = Selection()

    name: ClassVar[str] = ""
    inserts: ClassVar[bool] = False
    removes: ClassVar[bool] = False

    def __post_init__(self):
        if isinstance(self.of, str):
            object.__setattr__(self, "of", Selection(self.of))

    @abstractmethod
    def apply(self, state: Particles, colors: Colors) -> Particles:
        """Returns the changed state.

        Args:
            state: history of the rollout.
            colors: particles -> their rendered colours [N, 3].
        """


@dataclass(frozen=True)
class Remove(Operation):
    """Removes particles: ``Remove("frozen")`` removes the static background."""

    name: ClassVar[str] = "remove"
    removes: ClassVar[bool] = True

    def apply(self, state: Particles, colors: Colors) -> Particles:
        return state.select_rows(~self.of.mask(state))


@dataclass(frozen=True)
class Move(Operation):
    """Translates particles: ``Move("frozen", (0, 0, 0.1))`` raises the ground.

    Attributes:
        by: displacement in metres.
    """

    by: Vector = (0.0, 0.0, 0.0)
    name: ClassVar[str] = "move"

    def apply(self, state: Particles, colors: Colors) -> Particles:
        return _moved(state, self.of.mask(state), self.by)


@dataclass(frozen=True)
class Rotate(Operation):
    """Rotates particles and their velocities.

    Attributes:
        axis: direction of the axis in world coordinates.
        degrees: counter-clockwise angle.
        about: point on the axis in world coordinates (m); None: the mean of the selected particles of each scene.
    """

    axis: Vector = (0.0, 0.0, 1.0)
    degrees: float = 0.0
    about: Vector | None = None
    name: ClassVar[str] = "rotate"

    def __post_init__(self):
        super().__post_init__()
        if not math.hypot(*self.axis) > 0:
            raise InputError(f"axis must be a nonzero vector; got {list(self.axis)}")

    def apply(self, state: Particles, colors: Colors) -> Particles:
        chosen, means = self.of.mask(state), state.means
        vector = F.normalize(torch.tensor(self.axis, dtype=torch.float64), dim=0) * math.radians(self.degrees)
        quat = rotate_left(torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64), vector[None])
        matrix = rotation_matrices(quat)[0].to(means)
        if self.about is None:
            pivots = _centers(state, chosen)
        else:
            pivot = means.new_tensor(self.about, dtype=torch.float64)
            pivots = (pivot if (offset := state.row_offset()) is None else pivot - offset).to(means)
        fields = {name: (x - pivots) @ matrix.T + pivots for name, x in _attributes(state, "point").items()}
        fields |= {name: x @ matrix.T for name, x in _attributes(state, "vector").items()}
        if state.quats is not None:
            fields["quats"] = rotate_left(state.quats, vector.to(means).expand(state.n_rows, 3))
            fields["sh"] = rotate_harmonics(state.sh, matrix.expand(state.n_rows, 3, 3))
        else:
            state = with_attribute(state, "orientations")
            fields["orientations"] = quat_product(quat.to(means).expand_as(state.orientations), state.orientations)
        return _changed(state, chosen, fields)


@dataclass(frozen=True)
class Throw(Operation):
    """Adds a velocity to particles.

    Attributes:
        velocity: added velocity in m/step.
    """

    velocity: Vector = (0.0, 0.0, 0.0)
    name: ClassVar[str] = "throw"

    def apply(self, state: Particles, colors: Colors) -> Particles:
        chosen, table = self.of.mask(state), state.clouds
        if bool((state.activity[chosen] == FROZEN).any()):
            raise InputError("frozen particles cannot be thrown; select moving ones")
        newest = {table.scenes[q]: table.steps[q] for q in newest_clouds(table)}
        if len(newest) == len(table):
            raise InputError("a history of one step has no velocity; encode two steps or more")
        ages = torch.tensor([newest[scene] - step for scene, step in zip(table.scenes, table.steps)])
        back = ages.to(state.means)[state.row_cloud()][:, None] * state.means.new_tensor(self.velocity)
        known = {name: value for name in VELOCITIES if (value := getattr(state, name)) is not None}
        faster = {name: value + value.new_tensor(self.velocity) for name, value in known.items()}
        return _changed(state, chosen, {"means": state.means - back, **faster})


@dataclass(frozen=True)
class Recolor(Operation):
    """Changes the mean colour of particles and keeps their shading.

    Attributes:
        color: red, green and blue in [0, 1].
    """

    color: Vector = (0.5, 0.5, 0.5)
    name: ClassVar[str] = "recolor"

    def __post_init__(self):
        super().__post_init__()
        if not all(0 <= value <= 1 for value in self.color):
            raise InputError(f"color must be three numbers in [0, 1]; got {list(self.color)}")

    def apply(self, state: Particles, colors: Colors) -> Particles:
        chosen = self.of.mask(state)
        newest = chosen & newest_mask(state)
        mean = (colors(state)[newest] @ (grey := state.means.new_tensor(GREY))).mean().clamp(min=DARKEST)
        paint = torch.outer(state.means.new_tensor(self.color) / mean, grey).expand(state.n_rows, 3, 3)
        if state.sh is not None:
            return _changed(state, chosen, {"sh": painted(state.sh, paint)})
        state = with_attribute(state, "color_transform")
        return _changed(state, chosen, {"color_transform": paint @ state.color_transform})


@dataclass(frozen=True)
class Duplicate(Operation):
    """Adds a copy of particles.

    Attributes:
        by: displacement of the copy in metres.
    """

    by: Vector = (0.0, 0.0, 0.0)
    name: ClassVar[str] = "duplicate"
    inserts: ClassVar[bool] = True

    def apply(self, state: Particles, colors: Colors) -> Particles:
        chosen = self.of.mask(state)
        return joined_clouds(state, _moved(state, chosen, self.by).select_rows(chosen))


@dataclass(frozen=True)
class Insert(Operation):
    """Adds the particles of another scene, with its newest step aligned to the newest step of the state.

    The inserted particles are never in ``frozen_appearance``.

    Attributes:
        particles: one scene, encoded or simulated by the same model. A file of edits names its folder by ``scene``.
        by: displacement in metres from their positions in the other scene.
    """

    particles: Particles | None = None
    by: Vector = (0.0, 0.0, 0.0)
    name: ClassVar[str] = "insert"
    inserts: ClassVar[bool] = True

    def apply(self, state: Particles, colors: Colors) -> Particles:
        chosen, given = self.of.mask(self.particles), dataclasses.replace(self.particles, frozen_appearance=None)
        if len(newest_clouds(given.clouds)) != 1:
            raise InputError("particles must be of a single scene")
        for field, value in given.row_fields().items():
            mine = getattr(state, field)
            if not ATTRIBUTES[field].is_optional and (mine is None or mine.shape[1:] != value.shape[1:]):
                raise InputError(f"particles.{field} differs in shape from the state; insert those of the same model")
        given = given.select_rows(chosen).to(state.means.device)
        table, steps = state.clouds, given.clouds.steps
        newest = {table.scenes[q]: table.steps[q] for q in newest_clouds(table)}
        by_age = {steps[-1] - step: given.clouds.row_runs([q])[0] for q, step in enumerate(steps)}
        runs = [by_age.get(newest[scene] - step, (0, 0)) for scene, step in zip(table.scenes, table.steps)]
        counts = table.with_counts(b - a for a, b in runs)
        fields = {name: torch.cat([x[a:b] for a, b in runs]) for name, x in given.row_fields().items()}
        own = {"origin": state.origin, "world_offset": state.world_offset}
        here = dataclasses.replace(given, **own).with_clouds(counts, **fields)
        by = here.means.new_tensor(self.by, dtype=torch.float64)  # then plus the difference of the world offsets
        by = by if given.world_offset is None else by + given.world_offset[given.clouds.scenes[-1]]
        by = by if (offset := here.row_offset()) is None else by - offset
        return joined_clouds(state, _moved(here, torch.ones_like(here.activity, dtype=torch.bool), by))


OPERATIONS = {kind.name: kind for kind in (Remove, Move, Rotate, Throw, Recolor, Duplicate, Insert)}


@dataclass(frozen=True)
class Edit:
    """An operation at a step of a rollout.

    Attributes:
        step: step of the rollout, from 0; the operation is applied before the prediction of this step.
        operation: operation to apply.
    """

    step: int
    operation: Operation

    @property
    def where(self) -> str:
        """Step and operation, for error messages."""
        return f"edit at step {self.step}, {self.operation.name}"

    def apply(self, state: Particles, colors: Colors) -> Particles:
        """Applies the operation. Errors name its step."""
        with naming(self.where):
            return self.operation.apply(state, colors)


def by_step(edits: Iterable[Edit], n_steps: int, *, insert: bool, remove: bool) -> dict[int, list[Edit]]:
    """Step -> its edits in the given order, sorted by step.

    Args:
        edits: edits in any order.
        n_steps: steps of the rollout.
        insert: whether edits may add particles.
        remove: whether edits may remove particles.
    Raises:
        InputError: a step is out of range, or an edit adds or removes particles although this is off.
    """
    found: dict[int, list[Edit]] = {}
    for edit in sorted(_listed(edits), key=lambda edit: edit.step):
        if not 0 <= edit.step < n_steps:
            raise InputError(f"{edit.where}: the rollout has steps 0 to {n_steps - 1}")
        for asked, on, name in ((edit.operation.inserts, insert, "insert"), (edit.operation.removes, remove, "remove")):
            if asked and not on:
                raise InputError(f"{edit.where}: the plan has structure.{name} off")
        found.setdefault(edit.step, []).append(edit)
    return found


def structure_of(edits: Iterable[Edit]) -> StructureEffects:
    """Structure effects of a spec that allows ``edits``."""
    operations = [edit.operation for edit in _listed(edits)]
    return StructureEffects(any(o.inserts for o in operations), any(o.removes for o in operations))


def _listed(edits: Iterable[Edit]) -> list[Edit]:
    found = list(edits) if isinstance(edits, Iterable) else [None]
    if not all(isinstance(one, Edit) and isinstance(one.operation, Operation) for one in found):
        raise InputError(f"edits must be a list of gsim3d.effects.edits.Edit(step, operation); got {shown(edits)}")
    return found


def load_edits(path: str | Path, encode: Callable[[Path], Particles]) -> list[Edit]:
    """Reads edits from a YAML file: a list of mappings with ``step``, ``op`` and the fields of the operation.

    Args:
        path: YAML file. Scene folders are relative to its folder.
        encode: scene folder -> particles, for ``insert``.
    Raises:
        InputError: an entry is invalid; the message names file, step and operation.
    """
    return [_edit(one, f"{path}: edit {i}", Path(path).parent, encode) for i, one in enumerate(read_yaml(path, list))]


def _edit(values: Any, where: str, folder: Path, encode: Callable[[Path], Particles]) -> Edit:
    if not isinstance(values, dict):
        raise InputError(f"{where} must be a mapping; got {shown(values)}")
    step, op = (values := dict(values)).pop("step", None), values.pop("op", None)
    check_whole(f"{where}: step", step, 0)
    check_one_of(f"{where} at step {step}: op", op, OPERATIONS)
    where = f"{where} at step {step}, {op}"
    kind, given = OPERATIONS[op], {}
    if kind is Insert:
        if "particles" in values or not isinstance(values.get("scene"), str):
            raise InputError(f"{where}: scene must name a scene folder; got {shown(values.get('scene'))}")
        with naming(where):
            given["particles"] = encode(folder / values.pop("scene"))
    return Edit(step, dataclasses.replace(from_dict(kind, values, f"{where}: "), **given))


def _changed(state: Particles, chosen: Tensor, fields: dict[str, Tensor]) -> Particles:
    """Replaces attributes of the particles in the mask ``chosen`` (bool [N])."""
    masks = {name: chosen.reshape(-1, *[1] * (value.dim() - 1)) for name, value in fields.items()}
    mixed = {name: torch.where(masks[name], value, getattr(state, name)) for name, value in fields.items()}
    return dataclasses.replace(state, **mixed)


def _moved(state: Particles, chosen: Tensor, by: Vector | Tensor) -> Particles:
    by = by.to(state.means) if isinstance(by, Tensor) else state.means.new_tensor(by)
    return _changed(state, chosen, {name: x + by for name, x in _attributes(state, "point").items()})


def _attributes(state: Particles, kind: str) -> dict[str, Tensor]:
    """Attributes of ``state`` of this kind."""
    return {name: value for name, value in state.row_fields().items() if ATTRIBUTES[name].kind == kind}


def _centers(state: Particles, chosen: Tensor) -> Tensor:
    """Mean position [N, 3] of the ``chosen`` particles in the newest cloud of each particle's scene."""
    scene, chosen = state.row_scene(), chosen & newest_mask(state)
    one = F.one_hot(scene, int(scene.max()) + 1).to(state.means)
    sums = (one * chosen[:, None]).mT @ torch.cat([state.means, torch.ones_like(state.means[:, :1])], 1)
    return (sums[:, :3] / sums[:, 3:].clamp(min=1))[scene]
