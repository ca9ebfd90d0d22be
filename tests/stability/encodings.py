"""Encodings of a hard cloud and an ordinary one in the same call."""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.nn.multiview_encoder import Encoder
from gsim3d.train.loop import deterministic
from tests.nn.multiview_encoder.scenes import ROW_FIELDS, SIZE, make_encoder, make_frames
from tests.stability.setting import Measured, Setting
from tests.stability.steps import EXACT

VIEWS = [0, 0, 1, 1]  # the cloud of each image: the hard one is cloud 0
HARD = 2 * SIZE**2  # its rows


@dataclass(frozen=True)
class Encoding:
    """fields: of all particles.   grads: of the images and of all parameters, of a weighted sum of all fields."""

    fields: dict[str, Tensor]
    grads: dict[str, Tensor]


def encode(setting: Setting, frames: Frames, *, prepare=None, **changes) -> Encoding:
    """changes: of the encoder's configuration.   prepare: what to do to the encoder first."""
    encoder = make_encoder(**changes)
    if prepare is not None:
        prepare(encoder)
    encoder, frames = setting.to(encoder), setting.to(frames)
    images = frames.images.clone().requires_grad_()
    with deterministic():
        return _encode(encoder, frames, images)


def _encode(encoder: Encoder, frames: Frames, images: Tensor) -> Encoding:
    state = encoder(dataclasses.replace(frames, images=images))
    names = (*ROW_FIELDS, *(name for name in ("quats", "scales", "sh") if getattr(state, name) is not None))
    fields = {name: getattr(state, name) for name in names}
    total = sum(value.sum() for value in fields.values())
    sources = {"images": images, **dict(encoder.named_parameters())}
    found = torch.autograd.grad(total, list(sources.values()), allow_unused=True)
    grads = {n: torch.zeros_like(s) if g is None else g for (n, s), g in zip(sources.items(), found, strict=True)}
    return Encoding({name: value.detach() for name, value in fields.items()}, grads)


def ordinary(**changes) -> Frames:
    """Two clouds of two views each; ``changes`` replace fields."""
    return dataclasses.replace(make_frames(VIEWS), **changes)


def with_cameras(frames: Frames, **changes) -> Frames:
    return dataclasses.replace(frames, cameras=dataclasses.replace(frames.cameras, **changes))


def check_encoding(
    setting: Setting, measured: Measured, frames: Frames, *, bound: str = "encoder", prepare=None, **changes
) -> Encoding:
    """Finite forward and backward, near float64's; cloud 1 has the bits it has beside an ordinary cloud 0."""
    options = {"prepare": prepare, **changes}
    result, exact = (encode(where, frames, **options) for where in (setting, EXACT))
    measured.finite(*result.fields.values(), *result.grads.values())
    for name, expected in exact.fields.items():
        measured.close(result.fields[name], expected, f"{bound}_{setting.precision}", name)
    beside_ordinary = encode(setting, ordinary(), **options)
    for name, expected in beside_ordinary.fields.items():
        measured.same_bits(result.fields[name][HARD:], expected[HARD:], f"{name} of the other cloud")
    measured.same_bits(result.grads["images"][2:], beside_ordinary.grads["images"][2:], "gradient of the other images")
    return result
