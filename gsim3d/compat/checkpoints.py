"""Conversion of configurations and weights of older checkpoints to this version."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.step import StateLayout
from gsim3d.errors import InputError


def current_model(section: dict[str, Any]) -> dict[str, Any]:
    """Converts a saved ``model`` section to this version.

    Raises:
        InputError: this version does not support the model.
    """
    section = {name: dict(part) if isinstance(part, dict) else part for name, part in section.items()}
    if _is_released(section):
        section["release"] = True
    parts = {name: part for name, part in section.items() if isinstance(part, dict)}
    if "renderer" in parts:
        parts["renderer"].setdefault("jacobian", "clamped")  # before the option existed
    if "dynamics" in parts:
        _name_priors(parts["dynamics"])
    if "on_bad" in parts.get("stability", {}):
        parts["stability"]["on_invalid"] = parts["stability"].pop("on_bad")
    return section


def current_data(section: dict[str, Any]) -> dict[str, Any]:
    """Converts a saved ``data`` section: drops a textual ``near_far`` ("of each scene"), as version 0.1 wrote it."""
    return {name: value for name, value in section.items() if name != "near_far" or not isinstance(value, str)}


def _is_released(section: dict[str, Any]) -> bool:
    """Removes the switches for published behaviour from all parts; returns whether they were on."""
    found = {}
    for name in ("encoder", "dynamics", "renderer"):
        switches = section[name].pop("quirks", None) if isinstance(section.get(name), dict) else None
        if isinstance(switches, dict):
            found |= {f"{name}.quirks.{key}": value for key, value in switches.items()}
    on = [name for name, value in found.items() if value is True]
    if on and len(on) < len(found):
        advice = "import the published checkpoint again (gsim3d import)"
        raise InputError(f"model.{on[0]}: on, but other quirks are off, which is not supported: {advice}")
    return bool(on)


SWITCHES = {  # former switches of the dynamics with their defaults, replaced by the list of priors
    "position_waves": 0, "motion_length": None, "velocity": False, "deformation": False, "turning": False,
    "pushes": False, "solid": False, "gravity": None, "contact_length": None, "lights": (), "surfaces": False,
}  # fmt: skip
OCCLUSION = {"shading": "occlusion", "strength": 0.2, "unit": 0.1, "beam": 2.0}
PARAMETERS = {  # former name below "dynamics." -> name below "dynamics.priors."
    "gravity": "gravity.acceleration",
    "friction": "contact.friction",
    "skin": "contact.offset",
    "lights": "directional_light.directions",
    "strength": "directional_light.strength",
    "dimming": "directional_light.extinction",
}


def _name_priors(section: dict[str, Any]) -> None:
    """Replaces the switches in a saved dynamics section by a list of priors, in place."""
    switches = {name: section.pop(name, default) for name, default in SWITCHES.items()}
    if section.get("background") == "relit":
        section["background"] = "relightable"
    if switches != SWITCHES:
        section["priors"] = _priors_of(switches, section.get("position_length", 1.0))


def _priors_of(switches: dict[str, Any], position_length: float) -> list[dict[str, Any]]:
    """Returns the priors that older switches enabled, in the order of their weight columns."""
    motion_length, contact_length, gravity = (switches[f] for f in ("motion_length", "contact_length", "gravity"))
    velocity, deformation, pushes = (switches[f] for f in ("velocity", "deformation", "pushes"))
    if (motion_length is not None or deformation) and not velocity:
        raise InputError("model.dynamics.motion_length without velocity: not supported in this version; train again")
    if gravity is not None and not pushes:
        raise InputError("model.dynamics.gravity without pushes: not supported in this version; train again")
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
    """Splits weights of priors, which older versions stored as columns of shared layers, into layers of their own.

    The columns keep their order in the matrix products, so that results have equal bits.
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
    """Splits the last layer of the head; gains of "means" followed the displacements, other gains came last."""
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
