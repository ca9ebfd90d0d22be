"""What a scene calls for: effects that are not asked for are not computed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from gsim3d.effects.rules import Sleep, at_least, one_of
from gsim3d.effects.selection import Selection
from gsim3d.errors import InputError
from gsim3d.io.files import read_yaml, typed, write_whole

VERSION = 1
FILE = "effects.yaml"  # of a scene or of a whole data set, in its folder
BACKGROUNDS = ("frozen", "masked_out", "dynamic", "asymmetric")
CHANGING = ("all", "dynamic", "frozen", "none")
ACTIONS = ("keypoints3d",)


class UnsupportedEffect(InputError):
    """An effect that this model or this version cannot simulate; the message starts with "unsupported"."""


@dataclass(frozen=True)
class Actions:
    """What drives the scene from outside: points that are moved. Without names there is nothing to drive."""

    type: str = "keypoints3d"
    names: tuple[str, ...] = ()

    def __post_init__(self):
        one_of("dynamics.actions.type", self.type, ACTIONS)


@dataclass(frozen=True)
class Contact:
    """Pairs of bodies that may touch, named, and from how far [metres] they feel each other."""

    pairs: tuple[tuple[str, str], ...] = ()
    halo: float = 0.05

    def __post_init__(self):
        at_least("dynamics.contact.halo", self.halo, 0)


@dataclass(frozen=True)
class DynamicsEffects:
    """What moves and why.

    background: "frozen": particles marked frozen never move, and others see them; "asymmetric": likewise, by a model in
        which they see only each other, so that they are computed once a rollout; "masked_out": they are left out;
        "dynamic": every particle may move.
    history: steps that the model sees; None: as many as the model can use.
    actions: what drives the scene from outside.
    contact: pairs of bodies that may touch.
    sleep: when particles at rest are skipped.
    """

    background: str = "frozen"
    history: int | None = None
    actions: Actions | None = None
    contact: Contact | None = None
    sleep: Sleep | None = None

    def __post_init__(self):
        one_of("dynamics.background", self.background, BACKGROUNDS)
        if self.history is not None:
            at_least("dynamics.history", self.history, 1)


@dataclass(frozen=True)
class AppearanceEffects:
    """What changes its look.

    view_dependent: degree of the harmonics, 0 to 3; None: the model's.
    changing: whose dynamic latents change with time: "all", "dynamic", "frozen" (shadows fall on the background, bodies
        keep their look) or "none".
    held: bodies whose latents do not, whatever ``changing`` says: who is there when a rollout starts, by kind and box
        as in edits, stays held wherever it goes.
    opacity_changes: opacities change with time; None: where the model predicts it (explicit models do).
    """

    view_dependent: int | None = None
    changing: str = "all"
    opacity_changes: bool | None = None
    held: tuple[Selection, ...] = ()

    def __post_init__(self):
        held = (Selection(of) if isinstance(of, str) else of for of in self.held)
        object.__setattr__(self, "held", tuple(held))
        one_of("appearance.changing", self.changing, CHANGING)
        if self.view_dependent not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: appearance.view_dependent must be 0 to 3; got {self.view_dependent}")


@dataclass(frozen=True)
class StructureEffects:
    """Particles that come or go during a rollout (:mod:`gsim3d.effects.edits`)."""

    insert: bool = False
    remove: bool = False


@dataclass(frozen=True)
class OutputEffects:
    """Images to make, all in one pass. Colour is what is left on unless it is switched off.

    features: the latents of the particles, blended like colour.
    """

    rgb: bool = True
    depth: bool = False
    alpha: bool = False
    features: bool = False


@dataclass(frozen=True)
class EffectsSpec:
    """Everything absent is off; what makes up the model (history, view_dependent, opacity_changes) is the model's own.

    Example:
        >>> spec = EffectsSpec.from_dict({"dynamics": {"background": "masked_out", "history": 2}})
        >>> spec.dynamics.history, spec.outputs.depth
        (2, False)
        >>> EffectsSpec.from_dict(spec.to_dict()) == spec
        True
    """

    dynamics: DynamicsEffects = field(default_factory=DynamicsEffects)
    appearance: AppearanceEffects = field(default_factory=AppearanceEffects)
    structure: StructureEffects = field(default_factory=StructureEffects)
    outputs: OutputEffects = field(default_factory=OutputEffects)

    @classmethod
    def from_dict(cls, values: dict[str, Any] | None) -> EffectsSpec:
        """From nested plain values; unknown keys raise."""
        values = dict(values or {})
        version = values.pop("version", VERSION)
        if version != VERSION:
            raise InputError(f"effects: version must be {VERSION}; got {version}")
        return typed(cls, values, "effects")

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values; what is off or left to the model is absent."""
        return {"version": VERSION, **_differences(self)}

    @classmethod
    def load(cls, path: str | Path) -> EffectsSpec:
        """Reads a YAML (or JSON) file."""
        values = read_yaml(path, "effects")
        if values is not None and not isinstance(values, dict):
            raise InputError(f"effects: {path} must hold a mapping; got {type(values).__name__}")
        return cls.from_dict(values)

    @classmethod
    def of_scene(cls, folder: str | Path) -> EffectsSpec | None:
        """The spec that a scene ships: effects.yaml in its folder or, of a whole set, up to two folders above."""
        folder = Path(folder).absolute()
        for place in (folder, folder.parent, folder.parent.parent):
            if (place / FILE).is_file():
                return cls.load(place / FILE)
        return None

    def save(self, path: str | Path) -> None:
        """Writes YAML, or JSON where the name ends in .json."""
        path = Path(path)
        as_json = path.suffix == ".json"
        write_whole(path, json.dumps(self.to_dict(), indent=2) if as_json else yaml.safe_dump(self.to_dict()))

    @property
    def hash(self) -> str:
        """16 hex digits that two equal specs share, on any machine."""
        return hashlib.sha256(json.dumps(_whole(self.to_dict()), sort_keys=True).encode()).hexdigest()[:16]


def _differences(value: Any) -> dict[str, Any]:
    """Plain values of the fields of a dataclass that differ from those of a new one."""
    default, out = type(value)(), {}
    for f in dataclasses.fields(value):
        mine = getattr(value, f.name)
        if mine != getattr(default, f.name):
            out[f.name] = _differences(mine) if dataclasses.is_dataclass(mine) else _plain(mine)
    return out


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(v) for f in dataclasses.fields(value) if (v := getattr(value, f.name)) is not None}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _whole(value: Any) -> Any:
    """``value`` with integers for numbers that are whole: 1 and 1.0 are equal, and so must their hashes be."""
    if isinstance(value, dict):
        return {name: _whole(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
