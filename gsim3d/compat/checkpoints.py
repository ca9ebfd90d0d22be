"""Configurations and weights of older checkpoints in the terms of this version."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.step import StateLayout
from gsim3d.errors import InputError


def current_model(section: dict[str, Any]) -> dict[str, Any]:
    """A saved ``model`` section as this version writes it.

    Raises:
        InputError: it describes a model that this version does not have.
    """
    section = {name: dict(part) if isinstance(part, dict) else part for name, part in section.items()}
    if _is_released(section):
        section["release"] = True
    parts = {name: part for name, part in section.items() if isinstance(part, dict)}
    if "renderer" in parts:
        parts["renderer"].setdefault("jacobian", "clamped")  # older than the choice
    if "dynamics" in parts:
        _name_priors(parts["dynamics"])
    if "on_bad" in parts.get("stability", {}):
        parts["stability"]["on_invalid"] = parts["stability"].pop("on_bad")
    return section


def current_data(section: dict[str, Any]) -> dict[str, Any]:
    """A saved ``data`` section without ``near_far`` where it is text, "of each scene", as version 0.1 wrote."""
    return {name: value for name, value in section.items() if name != "near_far" or not isinstance(value, str)}


def _is_released(section: dict[str, Any]) -> bool:
    """Takes the switches for published behaviour out of all parts; whether they were on."""
    said = {}
    for name in ("encoder", "dynamics", "renderer"):
        switches = section[name].pop("quirks", None) if isinstance(section.get(name), dict) else None
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
OCCLUSION = {"shading": "occlusion", "strength": 0.2, "unit": 0.1, "beam": 2.0}
PARAMETERS = {  # of priors, by their older names below "dynamics."
    "gravity": "gravity.acceleration",
    "friction": "contact.friction",
    "skin": "contact.offset",
    "lights": "directional_light.directions",
    "strength": "directional_light.strength",
    "dimming": "directional_light.extinction",
}


def _name_priors(section: dict[str, Any]) -> None:
    """Puts a list of priors in place of switches into a saved section of the dynamics."""
    switches = {name: section.pop(name, default) for name, default in SWITCHES.items()}
    if section.get("background") == "relit":
        section["background"] = "relightable"
    if switches != SWITCHES:
        section["priors"] = _priors_of(switches, section.get("position_length", 1.0))


def _priors_of(switches: dict[str, Any], position_length: float) -> list[dict[str, Any]]:
    """The list of priors that older switches stood for, in the order of their columns."""
    motion_length, contact_length, gravity = (switches[f] for f in ("motion_length", "contact_length", "gravity"))
    velocity, deformation, pushes = (switches[f] for f in ("velocity", "deformation", "pushes"))
    if (motion_length is not None or deformation) and not velocity:
        raise InputError("model.dynamics.motion_length without velocity: this version has no such prior; train anew")
    if gravity is not None and not pushes:
        raise InputError("model.dynamics.gravity without pushes: this version has no such prior; train anew")
    window, waves, lights = {"radius": motion_length}, switches["position_waves"], switches["lights"]
    of_body = {"min_opacity": 0.5} if pushes else {}
    shape = {} if pushes else {"stiffness": 0.3, "position_gradients": False}
    shading = {"shading": "lambert"} if switches["surfaces"] else OCCLUSION
    priors = {
        "segmentation": pushes and {},
        "velocity_from_images": velocity and window,
        "position_waves": bool(waves) and {"count": waves, "longest": 4.0 * position_length},
        "proximity": contact_length is not None and {"range": contact_length, **of_body},
        "inertia": velocity and {**window, "rotate_appearance": switches["turning"]},
        "shape_matching": deformation and {**window, **shape},
        "gravity": gravity is not None and {**window, "acceleration": gravity},
        "contact": pushes and {**window, "rigid": switches["solid"]},
        "directional_light": bool(lights) and {"directions": lights, **shading},
    }
    return [{"type": name, **settings} for name, settings in priors.items() if settings is not False]


def current_weights(weights: Mapping[str, Tensor], dynamics: DynamicsConfig) -> dict[str, Tensor]:
    """Weights of a simulator with such ``dynamics``, where those of priors are part of others', under their own names.

    The products of the network have the same columns in the same order as before, so that results have equal bits.
    """
    weights, start = dict(weights), "dynamics.priors."
    stem, conditioning = "dynamics.net.stem.conv.weight", weights.pop("dynamics.net.stem.told.weight", None)
    if not dynamics.priors or stem not in weights or any(name.startswith(start) for name in weights):
        return weights
    for old, new in PARAMETERS.items():
        if f"dynamics.{old}" in weights:
            weights[start + new] = weights.pop(f"dynamics.{old}")
    priors = list(dynamics.build_priors())
    layout = StateLayout.of(dynamics, priors)
    convolved = weights[stem]
    weights[stem] = convolved[..., : layout.in_channels].clone()
    column, cond_column = layout.in_channels, 0
    for prior in priors:
        own = f"{start}{prior.name}"
        if n := prior.n_conv_features:
            weights[f"{own}.conv_proj.weight"] = convolved[..., column : column + n].clone()
            column += n
        if (n := prior.n_features) and conditioning is not None:
            weights[f"{own}.in_proj.weight"] = conditioning[:, cond_column : cond_column + n].clone()
            cond_column += n
    return weights | _split_head(weights, layout)


def _split_head(weights: Mapping[str, Tensor], layout: StateLayout) -> dict[str, Tensor]:
    """The last layer of the head and those of priors: gains of motions came behind displacements, others last."""
    of_means = [(name, n) for name, n, changed in layout.gains if changed == "means"]
    others = [(name, n) for name, n, changed in layout.gains if changed != "means"]
    order = []
    for name in ("dynamic_latents", "sh", "means", "opacities", "quats", "scales"):
        order += [(name, dict(layout.outputs).get(name, 0)), *(of_means if name == "means" else ())]
    names, widths = zip(*order, *others, strict=True)
    found = {}
    for kind in ("weight", "bias"):
        head = f"dynamics.net.head.fc2.{kind}"
        blocks = dict(zip(names, weights[head][: sum(widths)].split(widths), strict=True))
        found[head] = torch.cat([blocks[name] for name, _ in layout.outputs])
        found |= {f"dynamics.priors.{name}.gain_head.{kind}": blocks[name].clone() for name, *_ in layout.gains}
    return found
