"""What the network reads from a particle, what it writes, and how a prediction becomes the next state."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.harmonics import degree_damping
from gsim3d.types import FROZEN, Particles

SCALE_STEP_SHARE = 1 / 6  # of the range of scales, the most that one step changes a scale
POSITION_CHANNELS = 6


@dataclass(frozen=True)
class StateLayout:
    """Order and width of the channels: fields that change, then fields that do not, each by the alphabet.

    inputs, outputs: (field of Particles, channels). Positions are no input by themselves (``position_features`` appends
    six channels); a rotation is predicted as a rotation vector. Harmonics are flat as (3, K), quaternions as
    (x, y, z, w).
    """

    config: DynamicsConfig
    inputs: tuple[tuple[str, int], ...]
    outputs: tuple[tuple[str, int], ...]

    @classmethod
    def of(cls, config: DynamicsConfig) -> StateLayout:
        dynamic, static = config.dynamic_latents, config.static_latents
        if not config.explicit:
            inputs = [("dynamic_latents", dynamic), ("opacities", 1), ("static_latents", static)]
            outputs = [("dynamic_latents", dynamic), ("means", 3)]
        else:
            sh = 3 * (config.sh_degree + 1) ** 2
            inputs = [("dynamic_latents", dynamic), ("sh", sh), ("opacities", 1), ("quats", 4), ("scales", 3)]
            inputs += [("static_latents", static)]
            outputs = [("dynamic_latents", dynamic), ("sh", sh), ("means", 3), ("opacities", 1), ("quats", 3)]
            outputs += [("scales", 3)]
        return cls(config, *(tuple((name, n) for name, n in fields if n > 0) for fields in (inputs, outputs)))

    @property
    def in_channels(self) -> int:
        return sum(n for _, n in self.inputs) + POSITION_CHANNELS * self.config.position_features

    @property
    def out_channels(self) -> int:
        return sum(n for _, n in self.outputs)

    def pack(self, particles: Particles) -> Tensor:
        """[N, in_channels] of all rows."""
        columns = []
        for name, n in self.inputs:
            value = getattr(particles, name)
            if value is None or value[:1].numel() != n * min(1, particles.n_rows):
                got = "None" if value is None else list(value.shape)
                raise ValueError(f"Dynamics: particles.{name} must have {n} channels a row; got {got}")
            columns.append(_flat(name, value))
        if self.config.position_features:
            columns.append(position_features(particles, self.config.grid_size, self.config.position_length))
        return torch.cat(columns, 1)

    def advance(self, particles: Particles, prediction: Tensor) -> Particles:
        """The particles one step later. A prediction of 0 changes nothing; prediction [N, out_channels]."""
        parts = dict(zip(dict(self.outputs), prediction.split([n for _, n in self.outputs], 1), strict=True))
        return dataclasses.replace(particles, **self._updates(particles, parts))

    def _updates(self, particles: Particles, parts: dict[str, Tensor]) -> dict[str, Tensor]:
        config = self.config
        frozen = (particles.activity == FROZEN)[:, None]
        new = {"means": hold(frozen, particles.means, particles.means + bounded(parts["means"], config.max_step))}
        if "dynamic_latents" in parts:  # of frozen particles too: a shadow may fall on them
            new["dynamic_latents"] = particles.dynamic_latents + bounded(
                parts["dynamic_latents"], config.max_latent_step
            )
        if config.explicit:
            damping = degree_damping(config.sh_degree, particles.sh)
            new["sh"] = particles.sh + parts["sh"].unflatten(1, (3, -1)).mT * damping[:, None]
            opacities = (particles.opacities + parts["opacities"][:, 0]).clamp(
                0, None if config.quirks.unbounded_opacity else 1
            )
            new["opacities"] = hold(frozen[:, 0], particles.opacities, opacities)
            quats = rotate_left(particles.quats, parts["quats"])
            new["quats"] = quats if config.quirks.frozen_rows_turn else hold(frozen, particles.quats, quats)
            scales = particles.scales + bounded(
                parts["scales"], SCALE_STEP_SHARE * (config.scale_max - config.scale_min)
            )
            new["scales"] = hold(frozen, particles.scales, scales.clamp(config.scale_min, config.scale_max))
        return new


def _flat(name: str, value: Tensor) -> Tensor:
    """A field of Particles as [N, channels], in the order that published weights expect."""
    if name == "sh":
        return value.mT.flatten(1)
    if name == "quats":
        return value.roll(-1, 1)
    return value.reshape(value.shape[0], -1) if value.numel() else value.reshape(value.shape[0], 1)


def position_features(particles: Particles, grid_size: float, length: float) -> Tensor:
    """[N, 6]: position relative to the scene's origin in units of ``length``; position inside the cell, -1 to 1."""
    scene = particles.cloud_scene[particles.row_cloud()]
    relative = particles.means.double() - particles.origin[scene]
    with torch.no_grad():
        corner = torch.floor(relative / grid_size) * grid_size
    inside = (relative - corner) * (2 / grid_size) - 1
    return torch.cat([relative / length, inside], 1).to(particles.means.dtype)


def hold(frozen: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """``before`` where frozen: the same bits, and no gradient into the prediction."""
    return torch.where(frozen, before, after)


def bounded(x: Tensor, limit: float | None) -> Tensor:
    return x if limit is None else limit * torch.tanh(x)


def rotate_left(quats: Tensor, rotation_vectors: Tensor) -> Tensor:
    """Unit quaternions of ``quats`` turned further about world axes: exp(v) q.

    Of the two quaternions of a rotation the result is the one whose largest component is positive: the network reads
    quaternions, and should see one rotation as one.

    Args:
        quats: [N, 4] (w, x, y, z), not zero, any length.
        rotation_vectors: [N, 3] radians, world axes.
    """
    angle_squared = rotation_vectors.square().sum(1, keepdim=True)
    small = angle_squared < 1e-8
    angle = torch.where(small, 1.0, angle_squared).sqrt()
    # sin(angle / 2) / angle and cos(angle / 2), by their series where the quotient would lose its gradient
    ratio = torch.where(small, 0.5 - angle_squared / 48, torch.sin(angle / 2) / angle)
    w = torch.where(small, 1 - angle_squared / 8, torch.cos(angle / 2))
    v = ratio * rotation_vectors
    qw, qv = quats[:, :1], quats[:, 1:]
    turned = torch.cat([w * qw - (v * qv).sum(1, keepdim=True), w * qv + qw * v + torch.linalg.cross(v, qv)], 1)
    largest = turned.detach().gather(1, turned.detach().abs().argmax(1, keepdim=True))
    return turned / (turned.norm(dim=1, keepdim=True) * torch.where(largest < 0, -1, 1))
