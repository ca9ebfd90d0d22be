"""Configurations of older checkpoints in the terms of this version. Plain data in, plain data out."""

from __future__ import annotations

from typing import Any

from gsim3d.errors import InputError

PARTS = ("encoder", "dynamics", "renderer")


def current_model(section: dict[str, Any]) -> dict[str, Any]:
    """A saved ``model`` section as this version writes it.

    Raises:
        InputError: it describes a model that this version does not have.
    """
    section = {name: dict(part) if isinstance(part, dict) else part for name, part in section.items()}
    if _is_released(section):
        section["release"] = True
    if isinstance(section.get("renderer"), dict):  # older than the choice: clamped
        section["renderer"] = {"jacobian": "clamped", **section["renderer"]}
    if isinstance(section.get("dynamics"), dict) and section["dynamics"].get("background") == "relit":
        section["dynamics"]["background"] = "relightable"
    if isinstance(section.get("stability"), dict):
        section["stability"] = {"on_invalid" if k == "on_bad" else k: v for k, v in section["stability"].items()}
    return section


def _is_released(section: dict[str, Any]) -> bool:
    """Takes the switches for published behaviour out of all parts; whether they were on."""
    said = {}
    for name in PARTS:
        part = section.get(name)
        switches = part.pop("quirks", None) if isinstance(part, dict) else None
        if isinstance(switches, dict):
            said |= {f"{name}.quirks.{key}": value for key, value in switches.items()}
    on = [name for name, value in said.items() if value is True]
    if on and len(on) < len(said):
        raise InputError(
            f"model.{on[0]}: on, but others are off; models have all published behaviour or none: import the published "
            "checkpoint again (gsim3d import)"
        )
    return bool(on)
