"""Specs of the effects of a scene. Effects that are off are not computed."""

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
from gsim3d.errors import InputError, check_one_of
from gsim3d.io.files import read_yaml, shown, write_whole
from gsim3d.io.settings import from_dict

VERSION = 1
FILE = "effects.yaml"  # in the folder of a scene or of a data set
BACKGROUNDS = ("frozen", "masked_out", "dynamic", "asymmetric")
CHANGING = ("all", "dynamic", "frozen", "none")
POLICIES = ("exact", "approx")
REMOVED = {"contact": "pairs"}  # removed keys of old files -> their list, which must be empty


class UnsupportedEffect(InputError):
    """The model or version does not support an effect; the message starts with "unsupported"."""


@dataclass(frozen=True)
class Sleep:
    """Sleep of particles at rest. See :mod:`gsim3d.dynamics.sleep`."""

    policy: str = "exact"  #: "exact": whole scenes sleep; "approx": cubes of space sleep
    eps: float = 1e-3  #: largest change a step of a particle at rest: displacement along an axis in cells, and latents
    patience: int = 4  #: steps at rest before a particle sleeps; at least the model's history is used
    #: edge of the cubes in metres. Particles wake in time if velocities change by less than this a step.
    halo: float = 0.05

    def __post_init__(self):
        check_one_of("effects: dynamics.sleep.policy", self.policy, POLICIES)
        _at_least("dynamics.sleep.eps", self.eps, 0)
        _at_least("dynamics.sleep.patience", self.patience, 1)
        if not 0 < self.halo < math.inf:
            raise InputError(f"effects: dynamics.sleep.halo must be a length above 0; got {self.halo!r}")


@dataclass(frozen=True)
class DynamicsEffects:
    """Effects of the dynamics."""

    #: "frozen": frozen particles never move, and others attend to them; "asymmetric": the same with a model whose
    #: frozen particles attend only to each other, and are computed once a rollout; "masked_out": frozen particles are
    #: removed; "dynamic": all particles may move
    background: str = "frozen"
    history: int | None = None  #: steps in the model's input; None: as many as the model supports
    sleep: Sleep | None = None  #: sleep of particles at rest; None: off
    #: types of the points of actors that become action particles (:mod:`gsim3d.dynamics.actions`); empty: off
    actions: tuple[str, ...] = ()

    def __post_init__(self):
        check_one_of("effects: dynamics.background", self.background, BACKGROUNDS)
        if self.history is not None:
            _at_least("dynamics.history", self.history, 1)


@dataclass(frozen=True)
class AppearanceEffects:
    """Effects of the appearance."""

    view_dependent: int | None = None  #: degree of the spherical harmonics, 0 to 3; None: the model's
    #: particles whose dynamic latents change with time: "all", "dynamic", "frozen" (for example shadows on the
    #: background) or "none"
    changing: str = "all"
    #: whether opacities change with time; None: if the model predicts them (explicit models)
    opacity_changes: bool | None = None
    #: selections whose latents stay constant, whatever ``changing`` is; resolved once at the start of a rollout
    frozen_appearance: tuple[Selection, ...] = ()

    def __post_init__(self):
        selections = (Selection(of) if isinstance(of, str) else of for of in self.frozen_appearance)
        object.__setattr__(self, "frozen_appearance", tuple(selections))
        check_one_of("effects: appearance.changing", self.changing, CHANGING)
        if self.view_dependent not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: appearance.view_dependent must be 0 to 3; got {self.view_dependent}")


@dataclass(frozen=True)
class StructureEffects:
    """Changes of the number of particles during a rollout (:mod:`gsim3d.effects.edits`)."""

    insert: bool = False  #: whether edits may add particles
    remove: bool = False  #: whether edits may remove particles


@dataclass(frozen=True)
class OutputEffects:
    """Rendered images, all from one pass."""

    rgb: bool = True  #: colour
    depth: bool = False  #: depth along the optical axis in metres
    alpha: bool = False  #: coverage in [0, 1]
    features: bool = False  #: latents of the particles, blended as colours


@dataclass(frozen=True)
class EffectsSpec:
    """Effects to compute for a scene. Missing effects are off; history, view_dependent and opacity_changes then default
    to the model's.

    Attributes:
        dynamics: effects of the dynamics.
        appearance: effects of the appearance.
        structure: whether edits may add and remove particles.
        outputs: rendered images.

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
        """Returns the spec of nested plain values, also of older versions.

        Args:
            values: output of :meth:`to_dict`; None: the default spec.
        Raises:
            InputError: a key is unknown or removed, or a value has a wrong type or is out of range.
        """
        values = dict(values or {})
        version = values.pop("version", VERSION)
        if version != VERSION:
            raise InputError(f"effects: version must be {VERSION}; got {version}")
        return from_dict(cls, _converted(values), "effects: ")

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values that differ from the defaults."""
        return {"version": VERSION, **_differences(self)}

    @classmethod
    def load(cls, path: str | Path) -> EffectsSpec:
        """Reads a spec from the YAML or JSON file ``path``."""
        return cls.from_dict(read_yaml(path, dict | None))

    @classmethod
    def of_scene(cls, folder: str | Path) -> EffectsSpec | None:
        """Reads effects.yaml in the scene folder ``folder``, or up to two folders above; None if there is none."""
        folder = Path(folder).absolute()
        for around in (folder, folder.parent, folder.parent.parent):
            if (around / FILE).is_file():
                return cls.load(around / FILE)
        return None

    def save(self, path: str | Path) -> None:
        """Writes a YAML file, or JSON if ``path`` ends in .json."""
        path = Path(path)
        as_json = path.suffix == ".json"
        write_whole(path, json.dumps(self.to_dict(), indent=2) if as_json else yaml.safe_dump(self.to_dict()))

    @property
    def hash(self) -> str:
        """Hash of the spec, 16 hex digits, equal on all machines."""
        return hashlib.sha256(json.dumps(_whole(self.to_dict()), sort_keys=True).encode()).hexdigest()[:16]


def _converted(values: dict[str, Any]) -> dict[str, Any]:
    """Converts plain values of older versions. Raises InputError if a removed effect was on."""
    if isinstance(dynamics := values.get("dynamics"), dict):
        for name, what in REMOVED.items():
            old = dynamics.get(name)
            if old is not None and not (isinstance(old, dict) and not old.get(what)):
                raise UnsupportedEffect(f"unsupported effect dynamics.{name}: no model simulates it; leave it out")
        dynamics = {name: value for name, value in dynamics.items() if name not in REMOVED}
        if "actions" in dynamics and (old := dynamics["actions"]) is None or isinstance(old, dict):
            dynamics["actions"] = list((old or {}).get("names") or ())
        values = values | {"dynamics": dynamics}
    if isinstance(appearance := values.get("appearance"), dict) and "held" in appearance:
        if "frozen_appearance" in appearance:
            raise InputError("effects: appearance.held is the old name of frozen_appearance; leave it out")
        renamed = {"held": "frozen_appearance"}
        values = values | {"appearance": {renamed.get(name, name): value for name, value in appearance.items()}}
    return values


def _at_least(name: str, value: Any, least: int) -> None:
    whole = least == 1
    kind = "an integer" if whole else "a number"
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not value >= least:
        raise InputError(f"effects: {name} must be {kind} of at least {least}; got {shown(value)}")


def _differences(value: Any) -> dict[str, Any]:
    """Plain values of the fields of a dataclass that differ from the defaults."""
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
    """Replaces floats with integer values by integers, so that 1 and 1.0 have equal hashes."""
    if isinstance(value, dict):
        return {name: _whole(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
