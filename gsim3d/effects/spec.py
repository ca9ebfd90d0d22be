"""What a scene calls for: effects that are not asked for are not computed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from gsim3d.effects.selection import Selection
from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import read_yaml, shown, write_whole
from gsim3d.io.settings import from_dict

VERSION = 1
FILE = "effects.yaml"  # of a scene or of a whole data set, in its folder
BACKGROUNDS = ("frozen", "masked_out", "dynamic", "asymmetric")
CHANGING = ("all", "dynamic", "frozen", "none")
POLICIES = ("exact", "approx")
REMOVED = {"actions": "names", "contact": "pairs"}  # keys of dynamics in old files -> their list, which must be empty


class UnsupportedEffect(InputError):
    """An effect that this model or this version cannot simulate; the message starts with "unsupported"."""


@dataclass(frozen=True)
class Sleep:
    """When particles at rest are skipped.

    Attributes:
        policy: "exact": a scene sleeps as a whole; "approx": cubes of it do (:mod:`gsim3d.dynamics.sleep` has the
            bounds).
        eps: largest displacement per step of a particle at rest along an axis, in cells, and largest change of a
            latent.
        patience: steps at rest before a particle sleeps; at least as many as the model's history.
        halo: metres, edge of the cubes, and the change of speed per step up to which no particle wakes too late.
    """

    policy: str = "exact"
    eps: float = 1e-3
    patience: int = 4
    halo: float = 0.05

    def __post_init__(self):
        _one_of("dynamics.sleep.policy", self.policy, POLICIES)
        _at_least("dynamics.sleep.eps", self.eps, 0)
        _at_least("dynamics.sleep.patience", self.patience, 1)
        if not 0 < self.halo < math.inf:
            raise InputError(f"effects: dynamics.sleep.halo must be a length above 0; got {self.halo!r}")


@dataclass(frozen=True)
class DynamicsEffects:
    """What moves.

    Attributes:
        background: "frozen": particles marked frozen never move, and others see them; "asymmetric": the same, by a
            model in which frozen particles see only each other, so that they are computed once a rollout;
            "masked_out": they are left out; "dynamic": every particle may move.
        history: steps that the model sees; None: as many as the model can use.
        sleep: when particles at rest are skipped; None: never.
    """

    background: str = "frozen"
    history: int | None = None
    sleep: Sleep | None = None

    def __post_init__(self):
        _one_of("dynamics.background", self.background, BACKGROUNDS)
        if self.history is not None:
            _at_least("dynamics.history", self.history, 1)


@dataclass(frozen=True)
class AppearanceEffects:
    """Which appearance changes with time and view.

    Attributes:
        view_dependent: degree of the spherical harmonics, 0 to 3; None: the model's.
        changing: particles whose dynamic latents change with time: "all", "dynamic", "frozen" (shadows fall on the
            background, bodies keep their appearance) or "none".
        opacity_changes: whether opacities change with time; None: where the model predicts them (explicit models do).
        frozen_appearance: particles whose latents stay constant, whatever ``changing`` says. Resolved once, where a
            rollout starts: a selected particle stays so wherever it moves.
    """

    view_dependent: int | None = None
    changing: str = "all"
    opacity_changes: bool | None = None
    frozen_appearance: tuple[Selection, ...] = ()

    def __post_init__(self):
        selections = (Selection(of) if isinstance(of, str) else of for of in self.frozen_appearance)
        object.__setattr__(self, "frozen_appearance", tuple(selections))
        _one_of("appearance.changing", self.changing, CHANGING)
        if self.view_dependent not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: appearance.view_dependent must be 0 to 3; got {self.view_dependent}")


@dataclass(frozen=True)
class StructureEffects:
    """Particles that come or go during a rollout (:mod:`gsim3d.effects.edits`).

    Attributes:
        insert: whether edits may add particles.
        remove: whether edits may remove particles.
    """

    insert: bool = False
    remove: bool = False


@dataclass(frozen=True)
class OutputEffects:
    """Images to make, all in one pass.

    Attributes:
        rgb: colour.
        depth: metres along the camera's axis.
        alpha: coverage, 0 to 1.
        features: the latents of the particles, blended like colour.
    """

    rgb: bool = True
    depth: bool = False
    alpha: bool = False
    features: bool = False


@dataclass(frozen=True)
class EffectsSpec:
    """What to compute of a scene. Effects that are absent are off; history, view_dependent and opacity_changes are then
    the model's own.

    Attributes:
        dynamics: what moves.
        appearance: which appearance changes with time and view.
        structure: whether edits may add and remove particles.
        outputs: images to make.

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
        """The spec of nested plain values, those of older versions included.

        Args:
            values: as :meth:`to_dict` makes them; None: the default.
        Raises:
            InputError: a key is unknown or removed, or a value is of another type or out of range.
        """
        values = dict(values or {})
        version = values.pop("version", VERSION)
        if version != VERSION:
            raise InputError(f"effects: version must be {VERSION}; got {version}")
        return from_dict(cls, _converted(values), "effects: ")

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, without what is off or left to the model."""
        return {"version": VERSION, **_differences(self)}

    @classmethod
    def load(cls, path: str | Path) -> EffectsSpec:
        """The spec of the YAML (or JSON) file ``path``."""
        return cls.from_dict(read_yaml(path, dict | None))

    @classmethod
    def of_scene(cls, folder: str | Path) -> EffectsSpec | None:
        """The spec of effects.yaml in ``folder``, of a scene, or up to two folders above (a whole set's); else None."""
        folder = Path(folder).absolute()
        for around in (folder, folder.parent, folder.parent.parent):
            if (around / FILE).is_file():
                return cls.load(around / FILE)
        return None

    def save(self, path: str | Path) -> None:
        """Writes ``path``, a YAML file, or JSON if the name ends in .json."""
        path = Path(path)
        as_json = path.suffix == ".json"
        write_whole(path, json.dumps(self.to_dict(), indent=2) if as_json else yaml.safe_dump(self.to_dict()))

    @property
    def hash(self) -> str:
        """16 hex digits that two equal specs share, on any machine."""
        return hashlib.sha256(json.dumps(_whole(self.to_dict()), sort_keys=True).encode()).hexdigest()[:16]


def _converted(values: dict[str, Any]) -> dict[str, Any]:
    """Plain values of an older version as those of today. Raises InputError where a removed effect was on."""
    if isinstance(dynamics := values.get("dynamics"), dict):
        for name, what in REMOVED.items():
            old = dynamics.get(name)
            if old is not None and not (isinstance(old, dict) and not old.get(what)):
                raise UnsupportedEffect(f"unsupported effect dynamics.{name}: no model simulates it; leave it out")
        values = values | {"dynamics": {name: value for name, value in dynamics.items() if name not in REMOVED}}
    if isinstance(appearance := values.get("appearance"), dict) and "held" in appearance:
        if "frozen_appearance" in appearance:
            raise InputError("effects: appearance.held is the old name of frozen_appearance; leave it out")
        renamed = {"held": "frozen_appearance"}
        values = values | {"appearance": {renamed.get(name, name): value for name, value in appearance.items()}}
    return values


def _one_of(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(
            f"effects: {name} must be one of {', '.join(allowed)}; got {shown(value)}{did_you_mean(value, allowed)}"
        )


def _at_least(name: str, value: Any, least: int) -> None:
    whole = least == 1
    kind = "an integer" if whole else "a number"
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not value >= least:
        raise InputError(f"effects: {name} must be {kind} of at least {least}; got {shown(value)}")


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
