"""What a scene calls for: effects that are not asked for are not computed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from gsim3d.errors import InputError
from gsim3d.files import MAX_TEXT, read_file

VERSION = 1
BACKGROUNDS = ("frozen", "masked_out", "dynamic")
CHANGING = ("all", "dynamic", "none")


class UnsupportedEffect(InputError):
    """An effect that this model or this version cannot simulate; the message starts with "unsupported"."""


@dataclass(frozen=True)
class DynamicsEffects:
    """What moves and why.

    background: "frozen": particles marked frozen never move, and others see them; "masked_out": they are left out;
        "dynamic": every particle may move.
    history: steps that the model sees; None: as many as the model can use.
    actions: what drives the scene from outside.
    contact: pairs of bodies that may touch.
    sleep: when particles at rest are skipped.
    """

    background: str = "frozen"
    history: int | None = None
    actions: dict[str, Any] | None = None
    contact: dict[str, Any] | None = None
    sleep: dict[str, Any] | None = None


@dataclass(frozen=True)
class AppearanceEffects:
    """What changes its look.

    view_dependent: degree of the harmonics, 0 to 3; None: the model's.
    changing: whose dynamic latents change with time: "all" (a shadow may fall on the background), "dynamic" or "none".
    opacity_changes: opacities change with time; None: where the model predicts it (explicit models do).
    """

    view_dependent: int | None = None
    changing: str = "all"
    opacity_changes: bool | None = None


@dataclass(frozen=True)
class StructureEffects:
    """Particles that come or go during a rollout."""

    insert: bool = False
    remove: bool = False


@dataclass(frozen=True)
class OutputEffects:
    """Images to make beside colour."""

    depth: bool = False
    alpha: bool = False


@dataclass(frozen=True)
class EffectsSpec:
    """Everything absent is off; what makes up the model (history, view_dependent, opacity_changes) is then the model's own.

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

    def __post_init__(self):
        _one_of("dynamics.background", self.dynamics.background, BACKGROUNDS)
        _one_of("appearance.changing", self.appearance.changing, CHANGING)
        history = self.dynamics.history
        if history is not None and not (isinstance(history, int) and history >= 1):
            raise InputError(f"effects: dynamics.history must be an integer of at least 1; got {history!r}")
        if self.appearance.view_dependent not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: appearance.view_dependent must be 0 to 3; got {self.appearance.view_dependent}")

    @classmethod
    def from_dict(cls, values: dict[str, Any] | None) -> EffectsSpec:
        """From nested plain values; unknown keys raise."""
        values = dict(values or {})
        version = values.pop("version", VERSION)
        if version != VERSION:
            raise InputError(f"effects: version must be {VERSION}; got {version}")
        return _build(cls, values, "")

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values; what is off or left to the model is absent."""
        return {"version": VERSION, **_differences(self, EffectsSpec())}

    @classmethod
    def load(cls, path: str | Path) -> EffectsSpec:
        """Reads a YAML (or JSON) file."""
        text = read_file(path, MAX_TEXT)
        try:
            values = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(f"effects: {path} cannot be read: {' '.join(str(error).split())[:300]}") from None
        if values is not None and not isinstance(values, dict):
            raise InputError(f"effects: {path} must hold a mapping; got {type(values).__name__}")
        return cls.from_dict(values)

    def save(self, path: str | Path) -> None:
        """Writes YAML, or JSON where the name ends in .json."""
        path = Path(path)
        as_json = path.suffix == ".json"
        path.write_text(json.dumps(self.to_dict(), indent=2) if as_json else yaml.safe_dump(self.to_dict()))

    @property
    def hash(self) -> str:
        """16 hex digits that two equal specs share, on any machine."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Plan:
    """How a simulator will meet a spec.

    history: steps kept.   sh_degree: of rendered colours.
    kept: effects that are computed.   skipped: effects that are not -> why.
    unused: parameters of the model that no kept effect reads, by name.
    """

    spec: EffectsSpec
    history: int
    sh_degree: int
    kept: tuple[str, ...]
    skipped: dict[str, str]
    unused: tuple[str, ...] = ()


def make_plan(spec: EffectsSpec, *, history: int, sh_degree: int, changes_opacity: bool) -> Plan:
    """The plan of a model that sees up to ``history`` steps and colours of ``sh_degree``.

    Raises:
        UnsupportedEffect: the model, or this version, cannot simulate an effect of ``spec``.
    """
    for name, asked in {
        "dynamics.actions": spec.dynamics.actions,
        "dynamics.contact": spec.dynamics.contact,
        "dynamics.sleep": spec.dynamics.sleep,
        "structure.insert": spec.structure.insert,
        "structure.remove": spec.structure.remove,
    }.items():
        if asked:
            raise UnsupportedEffect(f"unsupported effect {name}: not simulated by this version; leave it out")
    if spec.appearance.opacity_changes and not changes_opacity:
        raise UnsupportedEffect("unsupported effect appearance.opacity_changes: this model holds opacities")
    wanted = {
        "dynamics.history": (spec.dynamics.history, history),
        "appearance.view_dependent": (spec.appearance.view_dependent, sh_degree),
    }
    chosen = {}
    for name, (asked, largest) in wanted.items():
        if asked is not None and asked > largest:
            raise UnsupportedEffect(f"unsupported effect {name}: this model goes up to {largest}; got {asked}")
        chosen[name] = largest if asked is None else asked
    history, sh_degree = chosen.values()
    switches = {
        "view-dependent colour": (sh_degree > 0, "degree 0 is asked for or all the model has"),
        "time merging": (history > 1, "a history of one step has nothing to merge"),
        "frozen background": (spec.dynamics.background == "frozen", f"background is {spec.dynamics.background}"),
        "changing features": (spec.appearance.changing != "none", "appearance.changing is none"),
        "changing opacities": (
            changes_opacity and spec.appearance.opacity_changes is not False,
            "appearance.opacity_changes is off" if changes_opacity else "this model holds opacities",
        ),
        "depth images": (spec.outputs.depth, "outputs.depth is off"),
        "alpha images": (spec.outputs.alpha, "outputs.alpha is off"),
        "actions": (False, "dynamics.actions is absent"),
        "insertion and removal": (False, "structure is absent"),
    }
    kept = tuple(name for name, (on, _) in switches.items() if on)
    return Plan(spec, history, sh_degree, kept, {name: why for name, (on, why) in switches.items() if not on})


def _one_of(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"effects: {name} must be one of {', '.join(allowed)}; got {value!r}")


def _build(cls: type, values: dict[str, Any], where: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(cls)}
    if unknown := sorted(set(values) - set(fields)):
        known = ", ".join(fields)
        raise InputError(f"effects: unknown key {where}{unknown[0]}; known: {known}")
    arguments = {}
    for name, value in values.items():
        factory = fields[name].default_factory
        nested = isinstance(factory, type) and dataclasses.is_dataclass(factory)
        if nested and not isinstance(value, dict):
            raise InputError(f"effects: {where}{name} must be a mapping; got {value!r}")
        arguments[name] = _build(factory, value, f"{where}{name}.") if nested else value
    return cls(**arguments)


def _differences(value: Any, default: Any) -> dict[str, Any]:
    out = {}
    for f in dataclasses.fields(value):
        mine, base = getattr(value, f.name), getattr(default, f.name)
        if mine != base:
            out[f.name] = _differences(mine, base) if dataclasses.is_dataclass(mine) else mine
    return out
