"""Configurations and weights of older checkpoints in the terms of this version."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.step import StateLayout
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
    if isinstance(section.get("dynamics"), dict):
        section["dynamics"] = _current_dynamics(section["dynamics"])
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


SWITCHES = {  # of the dynamics, and what they were by default, where priors are a list now
    "position_waves": 0,
    "motion_length": None,
    "velocity": False,
    "deformation": False,
    "turning": False,
    "pushes": False,
    "solid": False,
    "gravity": None,
    "contact_length": None,
    "lights": (),
    "surfaces": False,
}
PARAMETERS = {  # of priors, by their older names below "dynamics."
    "gravity": "gravity.acceleration",
    "friction": "contact.friction",
    "skin": "contact.offset",
    "lights": "directional_light.directions",
    "strength": "directional_light.strength",
    "dimming": "directional_light.extinction",
}


def _current_dynamics(section: dict[str, Any]) -> dict[str, Any]:
    """A saved section of the dynamics with a list of priors in place of switches."""
    switches = {name: section.pop(name, default) for name, default in SWITCHES.items()}
    if section.get("background") == "relit":
        section["background"] = "relightable"
    if any(switches[name] != default for name, default in SWITCHES.items()):
        section["priors"] = priors_of_switches(section.get("position_length", 1.0), **switches)
    return section


def priors_of_switches(
    position_length: float,
    *,
    position_waves: int,
    motion_length: float | None,
    velocity: bool,
    deformation: bool,
    turning: bool,
    pushes: bool,
    solid: bool,
    gravity: Any,
    contact_length: float | None,
    lights: Any,
    surfaces: bool,
) -> list[dict[str, Any]]:
    """The list of priors that older switches stood for, in the order of their columns.

    Raises:
        InputError: they stood for something that no prior does.
    """
    if (motion_length is not None or deformation) and not velocity:
        raise InputError("model.dynamics.motion_length without velocity: this version has no such prior; train anew")
    if gravity is not None and not pushes:
        raise InputError("model.dynamics.gravity without pushes: this version has no such prior; train anew")
    window = {"radius": motion_length}
    of_body = {"min_opacity": 0.5} if pushes else {}
    shape = {} if pushes else {"stiffness": 0.3, "position_gradients": False}
    shading = {"shading": "lambert"} if surfaces else OCCLUSION
    priors = {
        "segmentation": pushes and {},
        "velocity_from_images": velocity and window,
        "position_waves": bool(position_waves) and {"count": position_waves, "longest": 4.0 * position_length},
        "proximity": contact_length is not None and {"range": contact_length, **of_body},
        "inertia": velocity and {**window, "rotate_appearance": turning},
        "shape_matching": deformation and {**window, **shape},
        "gravity": gravity is not None and {**window, "acceleration": gravity},
        "contact": pushes and {**window, "rigid": solid},
        "directional_light": bool(lights) and {"directions": lights, **shading},
    }
    return [{"type": name, **settings} for name, settings in priors.items() if settings is not False]


OCCLUSION = {"shading": "occlusion", "strength": 0.2, "unit": 0.1, "beam": 2.0}


def current_weights(weights: Mapping[str, Tensor], dynamics: DynamicsConfig) -> dict[str, Tensor]:
    """Weights of a simulator with such ``dynamics``, where those of priors are part of others', under their own names.

    The products of the network have the same columns in the same order as before, so that results have equal bits.
    """
    weights, start = dict(weights), "dynamics.priors."
    stem, told = "dynamics.net.stem.conv.weight", weights.pop("dynamics.net.stem.told.weight", None)
    if not dynamics.priors or stem not in weights or any(name.startswith(start) for name in weights):
        return weights
    for old, new in PARAMETERS.items():
        if f"dynamics.{old}" in weights:
            weights[start + new] = weights.pop(f"dynamics.{old}")
    priors = list(dynamics.build_priors())
    layout, column, told_column = StateLayout.of(dynamics, priors), 0, 0
    own = layout.in_channels
    convolved = weights[stem]
    for prior in priors:
        if prior.n_conv_features:
            at = own + column
            weights[f"{start}{prior.name}.conv_proj.weight"] = convolved[..., at : at + prior.n_conv_features].clone()
            column += prior.n_conv_features
        if prior.n_features and told is not None:
            at, told_column = told_column, told_column + prior.n_features
            weights[f"{start}{prior.name}.in_proj.weight"] = told[:, at:told_column].clone()
    weights[stem] = convolved[..., :own].clone()
    return weights | _split_head(weights, layout)


def _split_head(weights: Mapping[str, Tensor], layout: StateLayout) -> dict[str, Tensor]:
    """The last layer of the head and those of priors: gains of motions came behind displacements, others last."""
    of_means = [(name, n) for name, n, changed in layout.gains if changed == "means"]
    others = [(name, n) for name, n, changed in layout.gains if changed != "means"]
    widths, rows, begin = dict(layout.outputs), {}, 0
    names = ["dynamic_latents", "sh", "means", "opacities", "quats", "scales"]
    order = [part for name in names for part in ((name, widths.get(name, 0)), *(of_means if name == "means" else ()))]
    for name, n in [*order, *others]:
        rows[name] = range(begin, begin + n)
        begin += n
    found = {}
    for kind in ("weight", "bias"):
        whole = weights[f"dynamics.net.head.fc2.{kind}"]
        base = torch.tensor([row for name, _ in layout.outputs for row in rows[name]], dtype=torch.int64)
        found[f"dynamics.net.head.fc2.{kind}"] = whole[base.to(whole.device)]
        for name, *_ in layout.gains:
            found[f"dynamics.priors.{name}.gain_head.{kind}"] = whole[rows[name].start : rows[name].stop].clone()
    return found
