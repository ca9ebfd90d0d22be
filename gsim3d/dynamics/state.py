"""What the network reads from a particle, what it writes, and how a prediction becomes the next state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.contact import CONTACT_CHANNELS
from gsim3d.dynamics.deformation import DEFORMATION_CHANNELS
from gsim3d.dynamics.flight import BACK, STIFF_BACK, Flight
from gsim3d.math.rotations import unit_quats
from gsim3d.math.spherical_harmonics import degree_damping
from gsim3d.nn.layers import widened
from gsim3d.state import FROZEN, Particles

SCALE_STEP_SHARE = 1 / 6  # of the range of scales, the most that one step changes a scale
POSITION_CHANNELS = MOTION_CHANNELS = 6
WAVE_CHANNELS = 6  # of each wave
OWN_CHANNELS = 3
LONGEST_WAVE = 4.0  # in units of position_length; each further wave is half as long
ONWARD = 1  # of the motions that gsim3d.dynamics.motion tells, the one that goes on if nothing is predicted
MOST_KEPT = 2.0  # how much more or less of a motion may go on
LIGHT_CHANNELS = 3  # of colours
MOST_LIGHT = 2.0  # logarithm of how much more or less light there may be
FEATURES = ("dynamic_latents", "sh", "irradiance_gain")  # that rows which are held keep
SMALL_ANGLE_SQUARED = 1e-8  # radians^2; smaller rotations are their series: a square root has no gradient at 0


@dataclass(frozen=True)
class StateLayout:
    """Order and width of the channels: fields that change, then fields that do not, each by the alphabet.

    inputs, outputs: (field of Particles, channels). Behind the inputs comes what the configuration adds to them:
    ``position_features`` and ``motion_length``; then what rows are ``told`` alone. A difference of rotations is
    predicted as a rotation vector about world axes. With ``motion_length`` further channels of positions say how much
    of each motion is kept along each axis: a contact takes a share, and where nothing of it is kept errors do not add
    up; with ``deformation`` also which share of the way back to its shape a row goes. With ``lights`` the last
    channels are the logarithm of how much more light reaches a row than what stands in it lets expect. Harmonics are
    flat as (3, K), quaternions as (x, y, z, w). The channels of ``outputs`` repeat for every step of a call.
    """

    config: DynamicsConfig
    inputs: tuple[tuple[str, int], ...]
    outputs: tuple[tuple[str, int], ...]

    @classmethod
    def of(cls, config: DynamicsConfig) -> StateLayout:
        dynamic, static = config.dynamic_latents, config.static_latents
        means = config.place_channels + MOTION_CHANNELS * (config.motion_length is not None)
        means += OWN_CHANNELS * config.velocity + DEFORMATION_CHANNELS * config.deformation
        if not config.explicit:
            inputs = [("dynamic_latents", dynamic), ("opacities", 1), ("static_latents", static)]
            outputs = [("dynamic_latents", dynamic), ("means", means)]
        else:
            sh = 3 * (config.sh_degree + 1) ** 2
            inputs = [("dynamic_latents", dynamic), ("sh", sh), ("opacities", 1), ("quats", 4), ("scales", 3)]
            inputs += [("static_latents", static)]
            rotation = 4 if config.predicts == "absolute" else 3
            outputs = [("dynamic_latents", dynamic), ("sh", sh), ("means", means), ("opacities", 1)]
            outputs += [("quats", rotation), ("scales", 3)]
        if config.lights:
            outputs.append(("irradiance_gain", LIGHT_CHANNELS))
        return cls(config, *(tuple((name, n) for name, n in fields if n > 0) for fields in (inputs, outputs)))

    @property
    def in_channels(self) -> int:
        """That are convolved."""
        known = sum(n for _, n in self.inputs) + POSITION_CHANNELS * self.config.position_features
        return known + MOTION_CHANNELS * (self.config.motion_length is not None)

    @property
    def told(self) -> tuple[tuple[str, int], ...]:
        """(setting, channels) of what follows them and is not."""
        config = self.config
        known = {
            "position_waves": WAVE_CHANNELS * config.position_waves,
            "contact_length": CONTACT_CHANNELS * (config.contact_length is not None),
            "velocity": OWN_CHANNELS * config.velocity,
            "deformation": DEFORMATION_CHANNELS * config.deformation,
            "lights": 2 * len(config.lights),
        }
        return tuple((name, n) for name, n in known.items() if n > 0)

    @property
    def told_channels(self) -> int:
        return sum(n for _, n in self.told)

    def changes(self, features: str = "all", opacities: bool = True) -> dict[str, str]:
        """Of each output, whose values a step changes: "all", "dynamic", "frozen" or "none".

        Args:
            features: whose latents and colours change. Those of frozen particles may: a shadow may fall on them.
            opacities: whether they change, where they are predicted.
        """
        who = {name: "dynamic" for name, _ in self.outputs}
        who |= {name: features for name in FEATURES if name in who}
        if "opacities" in who and not opacities:
            who["opacities"] = "none"
        if "quats" in who and self.config.frozen_turn:
            who["quats"] = "all"
        return who

    def columns(self, changes: Mapping[str, str]) -> list[tuple[int, int]] | None:
        """Runs of output channels that ``changes`` asks for; None: all of them."""
        runs, begin = [], 0
        for name, n in self.outputs * self.config.steps_per_call:
            if changes[name] != "none":
                runs.append((runs.pop()[0] if runs and runs[-1][1] == begin else begin, begin + n))
            begin += n
        return None if runs == [(0, begin)] else runs

    @property
    def out_channels(self) -> int:
        return self.config.steps_per_call * sum(n for _, n in self.outputs)

    def pack(
        self,
        particles: Particles,
        moved: Tensor | None = None,
        near: Tensor | None = None,
        shaded: Tensor | None = None,
    ) -> Tensor:
        """[N, in_channels + told_channels] of all rows.

        moved: [N, 2 to 4, 3] metres a step, of :mod:`gsim3d.dynamics.motion` or :mod:`gsim3d.dynamics.momentum` and,
                behind that, :mod:`gsim3d.dynamics.deformation`; None: nothing moved, and nothing is bent.
        near: [N, 4], of :func:`gsim3d.dynamics.contact.contact`; None: nothing is near.
        shaded: [N, 2 lights], what stands in the light of each lamp, and what stood there where rows were encoded;
            None: nothing.
        """
        config = self.config
        columns = []
        for name, n in self.inputs:
            value = getattr(particles, name)
            if value is None or value[:1].numel() != n * min(1, particles.n_rows):
                got = "None" if value is None else list(value.shape)
                raise ValueError(f"Dynamics: particles.{name} must have {n} channels a row; got {got}")
            columns.append(_flat(name, value))
        if config.position_features:
            columns.append(position_features(particles, config.grid_size, config.position_length))
        if config.motion_length is not None:
            told = dict(self.told)
            n_told = told.get("velocity", 0) + told.get("deformation", 0)
            still = particles.means.new_zeros(particles.n_rows, MOTION_CHANNELS + n_told)
            moved = still if moved is None else moved.flatten(1) / config.grid_size
            columns.append(moved[:, :MOTION_CHANNELS])
        if config.position_waves:
            columns.append(position_waves(particles, config.position_waves, config.position_length))
        if config.contact_length is not None:
            columns.append(particles.means.new_zeros(particles.n_rows, CONTACT_CHANNELS) if near is None else near)
        if config.velocity or config.deformation:
            columns.append(moved[:, MOTION_CHANNELS:])
        if config.lights:
            dark = particles.means.new_zeros(particles.n_rows, 2 * len(config.lights)) if shaded is None else shaded
            columns.append(dark)
        return torch.cat(columns, 1)

    def advance(
        self,
        particles: Particles,
        prediction: Tensor,
        awake: Tensor | None = None,
        changes: Mapping[str, str] | None = None,
        drift: Tensor | None = None,
        flight: Flight | None = None,
    ) -> list[Particles]:
        """The particles after 1, 2, ... ``steps_per_call`` steps, in the light of before (:meth:`later_light`).

        Args:
            particles: N rows, the newest state; those that are ``held`` keep their latents and colours.
            prediction: [N, channels], the outputs that change.
            awake: bool [N], rows that change at all; None: all.
            changes: of :meth:`changes`; None: all that is predicted.
            drift: as ``moved`` of :meth:`pack`, motions that go on as far as they are kept; None: none.
            flight: as of :meth:`later_values`.
        """
        changes = changes or self.changes()
        later = {}
        for name, part in self._parts(prediction, changes).items():
            if name == "irradiance_gain":
                continue
            share = self._share(particles, changes[name], awake, name in FEATURES)
            onward = (drift, flight) if name == "means" else ()
            later[name] = self.later_values(name, getattr(particles, name), part, share, *onward)
        return [
            dataclasses.replace(particles, **{name: values[step] for name, values in later.items()})
            for step in range(self.config.steps_per_call)
        ]

    def later_light(
        self,
        particles: Particles,
        prediction: Tensor,
        brighter: Tensor,
        awake: Tensor | None = None,
        changes: Mapping[str, str] | None = None,
    ) -> Tensor:
        """[S, N, 3], the light after 1, 2, ... steps: not of the step before, or its errors would add up.

        Args:
            brighter: [S, N, 3], its logarithm if nothing is predicted.
            others: as of :meth:`advance`.
        """
        changes = changes or self.changes()
        who, predicted = changes["irradiance_gain"], self._parts(prediction, changes).get("irradiance_gain")
        share = self._share(particles, who, awake, True)
        if self.config.surfaces:  # their light has bounds of its own, and reaches all, whose look changes otherwise
            if predicted is not None:
                brighter = brighter + share * bounded(predicted / MOST_LIGHT, MOST_LIGHT)
            share = self._share(particles, "all", awake, True)
        elif predicted is not None:
            brighter = bounded((predicted + brighter) / MOST_LIGHT, MOST_LIGHT)
        return hold(share, particles.irradiance_gain, brighter.exp())

    def _parts(self, prediction: Tensor, changes: Mapping[str, str]) -> dict[str, Tensor]:
        """[S, N, channels] of each output that changes."""
        outputs = [(name, n) for name, n in self.outputs if changes[name] != "none"]
        parts = widened(prediction).unflatten(1, (self.config.steps_per_call, -1)).transpose(0, 1)
        return {name: part for (name, _), part in zip(outputs, parts.split([n for _, n in outputs], 2), strict=True)}

    @staticmethod
    def _share(particles: Particles, who: str, awake: Tensor | None, is_look: bool) -> Tensor:
        """[N, 1], 1 of rows that change where ``who`` does; of a look 0 of those that are ``held``."""
        frozen = particles.activity == FROZEN
        rows = {"all": torch.ones_like(frozen), "dynamic": ~frozen, "frozen": frozen}.get(who, torch.zeros_like(frozen))
        if awake is not None:
            rows = rows & awake
        if is_look and particles.frozen_appearance is not None:
            rows = rows.masked_fill(particles.frozen_appearance, False)
        return rows[:, None].to(particles.means)

    def later_values(
        self,
        name: str,
        newest: Tensor,
        predicted: Tensor,
        share: Tensor,
        drift: Tensor | None = None,
        flight: Flight | None = None,
    ) -> Tensor:
        """One field of the particles after each step of a call.

        Args:
            name: of the field.
            newest: [N, ...], its newest values.
            predicted: [S, N, channels], of S steps.
            share: [N, 1] or [S, N, 1], how much of a predicted change happens: 0 holds the value, bit by bit.
            drift: of means [N, 2 to 4, 3], what is added in every step as far as it is kept; None: nothing.
            flight: of means with ``drift``: motions are all kept by what is near nothing frozen, and what touches
                nothing of it falls and goes nowhere else; None: no row flies.
        Returns:
            [S, N, ...].
        """
        if name == "quats":
            return self._later_quats(newest, predicted, share)
        predicted = _unflat(name, predicted)
        if name == "means":
            n = self.config.place_channels
            predicted, kept = F.pad(predicted[..., :n], (0, 3 - n)), predicted[..., n:]
        share = share.reshape(*share.shape[:-1], *(1,) * (newest.dim() - 1))
        changes = self._target(name, predicted) - newest if self._absolute else self._change(name, predicted)
        if self.config.predicts == "from_previous":
            changes = changes.cumsum(0)
        if drift is not None:
            kept = bounded(kept / MOST_KEPT, MOST_KEPT).unflatten(2, drift.shape[1:])
            ahead = torch.arange(1, 1 + changes.shape[0], device=drift.device, dtype=drift.dtype)[:, None, None]
            if flight is not None:
                by_itself, way = STIFF_BACK if self.config.pushes else BACK, drift[:, -1]
                if flight.pushes is not None:  # gradients: without them stiffness would be learned wrongly
                    way = way - (newest - newest.detach())
                shares = (kept[0, :, :-1] * drift[:, :-1]).sum(1)
                back = (by_itself + kept[0, :, -1]) * way
                changes = flight.moves(drift[:, ONWARD], changes[0], shares, back)[None]
            else:
                onward = ahead * (drift[:, ONWARD] + (kept * drift).sum(2))
                if self.config.deformation:
                    onward = onward + (1 - (1 - BACK) ** ahead) * drift[:, -1]
                changes = changes + onward
            most = math.inf if self.config.max_step is None else self.config.max_step
            changes = torch.minimum(torch.maximum(changes, -most * ahead), most * ahead)
        return hold(share, newest, self._in_range(name, newest + share * changes))

    @property
    def _absolute(self) -> bool:
        return self.config.predicts == "absolute"

    def _change(self, name: str, predicted: Tensor) -> Tensor:
        config = self.config
        if name == "means":
            return bounded(predicted, config.max_step)
        if name == "dynamic_latents":
            return bounded(predicted, config.max_latent_step)
        if name == "scales" and config.max_step is not None:
            return bounded(predicted, SCALE_STEP_SHARE * (config.scale_max - config.scale_min))
        return self._damped(predicted) if name == "sh" else predicted

    def _target(self, name: str, predicted: Tensor) -> Tensor:
        config = self.config
        if name == "opacities":
            return predicted.sigmoid()
        if name == "scales":
            return config.scale_min + (config.scale_max - config.scale_min) * predicted.sigmoid()
        return self._damped(predicted) if name == "sh" else predicted

    def _damped(self, sh: Tensor) -> Tensor:
        return sh * degree_damping(self.config.sh_degree, sh)[:, None]

    def _in_range(self, name: str, value: Tensor) -> Tensor:
        if name == "scales":
            return value.clamp(self.config.scale_min, self.config.scale_max)
        if name == "opacities":
            return value.clamp(0, self.config.max_opacity)
        return value

    def _later_quats(self, newest: Tensor, predicted: Tensor, share: Tensor) -> Tensor:
        """As :meth:`later_values`, of rotations: unit quaternions, except where nothing changes."""
        if self._absolute:
            target = predicted.roll(1, 2)
            return hold(share, newest, unit_quats(newest + share * (target - newest)))
        later, before = [], newest
        for vectors in (share * predicted).unbind(0):
            later.append(rotate_left(before, vectors))
            before = later[-1] if self.config.predicts == "from_previous" else newest
        return hold(share, newest, torch.stack(later))


def _flat(name: str, value: Tensor) -> Tensor:
    """A field of Particles as [N, channels], in the order that published weights expect."""
    if name == "sh":
        return value.mT.flatten(1)
    if name == "quats":
        return value.roll(-1, 1)
    return value.flatten(1) if value.dim() > 1 else value[:, None]


def _unflat(name: str, value: Tensor) -> Tensor:
    """[S, N, channels] -> [S, N, ...] as in Particles."""
    if name == "sh":
        return value.unflatten(2, (3, -1)).mT
    return value[:, :, 0] if name == "opacities" else value


def position_features(particles: Particles, grid_size: float, length: float) -> Tensor:
    """[N, 6]: position relative to the scene's origin in units of ``length``; position inside the cell, -1 to 1."""
    relative = _from_origin(particles)
    with torch.no_grad():
        corner = torch.floor(relative / grid_size) * grid_size
    inside = (relative - corner) * (2 / grid_size) - 1
    return torch.cat([relative / length, inside], 1).to(particles.means.dtype)


def position_waves(particles: Particles, n: int, length: float) -> Tensor:
    """[N, 6 n]: sines and cosines of the position relative to the scene's origin, of ``n`` waves along each axis from
    ``LONGEST_WAVE`` times ``length`` down."""
    angles = _from_origin(particles) * (2 * math.pi / (LONGEST_WAVE * length))
    angles = torch.stack([2**k * angles for k in range(n)], 1)
    return torch.stack([angles.sin(), angles.cos()], 2).flatten(1).to(particles.means.dtype)


def _from_origin(particles: Particles) -> Tensor:
    """float64 [N, 3]."""
    return particles.means.double() - particles.origin[particles.cloud_scene[particles.row_cloud()]]


def hold(share: Tensor, newest: Tensor, later: Tensor) -> Tensor:
    """``newest`` where the share is 0: the same bits, and no gradient into the prediction."""
    return torch.where(share > 0, later, newest)


def bounded(x: Tensor, limit: float | None) -> Tensor:
    return x if limit is None else limit * torch.tanh(x)


def rotate_left(quats: Tensor, rotation_vectors: Tensor) -> Tensor:
    """Unit quaternions of ``quats`` turned further about world axes: exp(v) q.

    Of the two quaternions of a rotation the result is the one whose largest component is positive: the network reads
    quaternions, and should see one rotation as one.

    Args:
        quats: [N, 4] (w, x, y, z), any length; shorter than 1e-6 counts as the identity and has no gradient.
        rotation_vectors: [N, 3] radians, world axes.
    """
    angle_squared = rotation_vectors.square().sum(1, keepdim=True)
    small = angle_squared < SMALL_ANGLE_SQUARED
    angle = torch.where(small, 1.0, angle_squared).sqrt()
    # sin(angle / 2) / angle and cos(angle / 2), by their series where the quotient would lose its gradient
    ratio = torch.where(small, 0.5 - angle_squared / 48, torch.sin(angle / 2) / angle)
    w = torch.where(small, 1 - angle_squared / 8, torch.cos(angle / 2))
    v = ratio * rotation_vectors
    quats = unit_quats(quats)
    qw, qv = quats[:, :1], quats[:, 1:]
    turned = torch.cat([w * qw - (v * qv).sum(1, keepdim=True), w * qv + qw * v + torch.linalg.cross(v, qv)], 1)
    largest = turned.detach().gather(1, turned.detach().abs().argmax(1, keepdim=True))
    return torch.where(largest < 0, -turned, turned)
