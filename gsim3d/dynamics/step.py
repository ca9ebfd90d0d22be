"""Layout of the network's input and output channels, and the update of particles by its outputs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.math.rotations import rotate_left, unit_quats
from gsim3d.math.spherical_harmonics import degree_damping
from gsim3d.nn.layers import widened
from gsim3d.priors import Prior
from gsim3d.priors.base import bounded, hold
from gsim3d.priors.position_waves import relative_positions
from gsim3d.state import FROZEN, Particles

SCALE_STEP_SHARE = 1 / 6  # largest change of a scale in a step, over the range of scales
POSITION_CHANNELS = 6
APPEARANCE = ("dynamic_latents", "sh", "irradiance_gain")  # constant for particles in frozen_appearance


@dataclass(frozen=True)
class StateLayout:
    """Order and width of the network's input and output channels.

    SH coefficients are flattened as (3, K), quaternions as (x, y, z, w). Changes of rotations are predicted as rotation
    vectors in world axes. Outputs repeat for each step of a call; the gains of priors follow them.
    """

    config: DynamicsConfig  #: configuration of the model
    inputs: tuple[tuple[str, int], ...]  #: (attribute, channels) pairs
    outputs: tuple[tuple[str, int], ...]  #: (attribute, channels) pairs of one step
    gains: tuple[tuple[str, int, str], ...] = ()  #: (prior, channels, attribute that the gains change)

    @classmethod
    def of(cls, config: DynamicsConfig, priors: Iterable[Prior] = ()) -> StateLayout:
        """The layout of a model with these priors."""
        dynamic, static, priors = config.dynamic_latents, config.static_latents, list(priors)
        means = 0 if any(prior.replaces_displacement for prior in priors) else 3
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
        inputs, outputs = (tuple((name, n) for name, n in fields if n > 0) for fields in (inputs, outputs))
        gains = tuple((prior.name, prior.n_gains, prior.gains_change) for prior in priors if prior.n_gains)
        return cls(config, inputs, outputs, gains)

    @property
    def in_channels(self) -> int:
        return sum(n for _, n in self.inputs) + POSITION_CHANNELS * self.config.position_features

    @property
    def out_channels(self) -> int:
        """Output channels of all steps of a call, without gains."""
        return self.config.steps_per_call * sum(n for _, n in self.outputs)

    def changes(self, features: str = "all", opacities: bool = True) -> dict[str, str]:
        """Predicted attribute -> particles that a step changes: "all", "dynamic", "frozen" or "none". ``features``:
        whose latents and colours change, of frozen ones as by a shadow; ``opacities``: whether predicted ones do."""
        names = [name for name, _ in self.outputs] + ["means"] + [changed for *_, changed in self.gains]
        changes = {name: features if name in APPEARANCE else "dynamic" for name in names}
        if "opacities" in changes and not opacities:
            changes["opacities"] = "none"
        if "quats" in changes and self.config.frozen_turn:
            changes["quats"] = "all"
        return changes

    def _columns(self, changes: Mapping[str, str]) -> list[tuple[str, int, bool]]:
        """(attribute or prior, channels, whether it is computed) in the order of the output channels."""
        outputs = [(name, n, changes[name] != "none") for name, n in self.outputs]
        gains = [(prior, n, changes[changed] != "none") for prior, n, changed in self.gains]
        return outputs * self.config.steps_per_call + gains

    def columns(self, changes: Mapping[str, str]) -> list[tuple[int, int]] | None:
        """Ranges of output channels that ``changes`` needs; None: all channels."""
        runs, begin = [], 0
        for _, n, computed in self._columns(changes):
            if computed:
                runs.append((runs.pop()[0] if runs and runs[-1][1] == begin else begin, begin + n))
            begin += n
        return None if runs == [(0, begin)] else runs

    def split(self, prediction: Tensor, changes: Mapping[str, str]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Splits a prediction into outputs [S, N, channels] for S steps, and gains [N, channels] by prior."""
        computed = [(name, n) for name, n, computed in self._columns(changes) if computed]
        parts = widened(prediction).split([n for _, n in computed], 1)
        priors, outputs, gains = {name for name, *_ in self.gains}, {}, {}
        for (name, _), part in zip(computed, parts, strict=True):
            if name in priors:
                gains[name] = part
            else:
                outputs.setdefault(name, []).append(part)
        outputs = {name: s[0][None] if len(s) == 1 else torch.stack(s) for name, s in outputs.items()}
        return outputs, gains

    def input_columns(self, particles: Particles) -> list[Tensor]:
        """Network input of all particles, as columns [N, n] of ``in_channels`` in all."""
        config, columns = self.config, []
        for name, n in self.inputs:
            value = getattr(particles, name)
            if value is None or value[:1].numel() != n * min(1, particles.n_rows):
                got = "None" if value is None else list(value.shape)
                raise ValueError(f"Dynamics: particles.{name} must have {n} channels; got {got}")
            columns.append(_flat(name, value))
        if config.position_features:
            columns.append(position_features(particles, config.grid_size, config.position_length))
        return columns

    def displacements(self, particles: Particles, outputs: Mapping[str, Tensor]) -> Tensor:
        """Predicted displacements [S, N, 3] in metres from the newest positions, for each step of a call."""
        if "means" not in outputs:
            return torch.zeros_like(particles.means)[None]
        return self._differences("means", particles.means, outputs["means"])

    def advance(
        self,
        particles: Particles,
        outputs: Mapping[str, Tensor],
        displacements: Tensor,
        awake: Tensor | None = None,
        changes: Mapping[str, str] | None = None,
    ) -> list[Particles]:
        """Particles after each of the ``steps_per_call`` steps from the newest state ``particles`` [N], by ``outputs``
        of :meth:`split` and ``displacements`` [S, N, 3] in metres. Particles in ``frozen_appearance`` keep latents and
        colours. ``awake``: bool [N], particles that may change, None: all; ``changes``: of :meth:`changes`."""
        changes = changes or self.changes()
        rows, means = self.rows(particles, "means", changes["means"], awake), particles.means[None]
        later = {"means": hold(rows, means, means + displacements)}
        for name in (name for name in outputs if name != "means"):
            newest, rows = getattr(particles, name), self.rows(particles, name, changes[name], awake)
            changed = self.later_values(name, newest, outputs[name], rows)
            later[name] = hold(rows.view(-1, *[1] * (newest.dim() - 1)), newest[None], changed)
        # A view of the only step: its gradient is not copied.
        later = {name: x.unbind() if len(x) > 1 else (x.squeeze(0),) for name, x in later.items()}
        steps = (dict(zip(later, values)) for values in zip(*later.values(), strict=True))
        return [dataclasses.replace(particles, **step) for step in steps]

    @staticmethod
    def rows(particles: Particles, name: str, which: str, awake: Tensor | None) -> Tensor:
        """Mask bool [N, 1] of particles whose attribute ``name`` changes for ``which``."""
        activity, mask = particles.activity, awake
        if which in ("dynamic", "frozen"):
            chosen = activity == FROZEN if which == "frozen" else activity != FROZEN
            mask = chosen if awake is None else chosen & awake
        elif which == "none" or awake is None:
            mask = torch.full_like(activity, which == "all", dtype=torch.bool)
        if name in APPEARANCE and particles.frozen_appearance is not None:
            mask = mask.masked_fill(particles.frozen_appearance, False)
        return mask[:, None]

    def later_values(self, name: str, newest: Tensor, predicted: Tensor, share: Tensor) -> Tensor:
        """Values [S, N, ...] of an attribute after each step of a call, from the ``newest`` ones [N, ...] and network
        outputs [S, N, channels]; ``share``: factor [N, 1] of the predicted change, or mask of rows that change."""
        if name == "quats":
            return self._later_quats(newest, predicted, share)
        share = share.reshape(*share.shape[:-1], *(1,) * (newest.dim() - 1))
        changed = newest[None] + share * self._differences(name, newest, predicted)
        if name == "scales":
            return changed.clamp(self.config.scale_min, self.config.scale_max)
        return changed.clamp(0, self.config.max_opacity) if name == "opacities" else changed

    def _differences(self, name: str, newest: Tensor, predicted: Tensor) -> Tensor:
        """Change [S, N, ...] of an attribute from its newest values, for each step."""
        if name == "sh":
            damping = degree_damping(self.config.sh_degree, predicted)
            predicted = predicted.unflatten(2, (3, -1)).mT * damping[:, None]
        if name == "opacities":
            predicted = predicted[:, :, 0]
        if self.config.predicts == "absolute":
            return self._target(name, predicted) - newest
        changes = self._change(name, predicted)
        return changes.cumsum(0) if self.config.predicts == "from_previous" else changes

    def _change(self, name: str, predicted: Tensor) -> Tensor:
        config = self.config
        if name == "means":
            return bounded(predicted, config.max_step)
        if name == "dynamic_latents":
            return bounded(predicted, config.max_latent_step)
        if name == "scales" and config.max_step is not None:
            return bounded(predicted, SCALE_STEP_SHARE * (config.scale_max - config.scale_min))
        return predicted

    def _target(self, name: str, predicted: Tensor) -> Tensor:
        config, predicted = self.config, predicted.contiguous()  # a CPU rounds sigmoids of strided rows otherwise
        if name == "opacities":
            return predicted.sigmoid()
        if name == "scales":
            return config.scale_min + (config.scale_max - config.scale_min) * predicted.sigmoid()
        return predicted

    def _later_quats(self, newest: Tensor, predicted: Tensor, share: Tensor) -> Tensor:
        """:meth:`later_values` of quaternions, which are normalised where they change."""
        if self.config.predicts == "absolute":
            target = predicted.roll(1, 2)
            return unit_quats(newest + share * (target - newest))
        later, before = [], newest
        for vectors in (share * predicted).unbind(0):
            later.append(rotate_left(before, vectors))
            before = later[-1] if self.config.predicts == "from_previous" else newest
        return torch.stack(later)


def _flat(name: str, value: Tensor) -> Tensor:
    """An attribute as [N, channels], in the order of the published weights."""
    if name == "sh":
        return value.mT.flatten(1)
    if name == "quats":
        return value.roll(-1, 1)
    return value.flatten(1) if value.dim() > 1 else value[:, None]


def position_features(particles: Particles, grid_size: float, length: float) -> Tensor:
    """Position relative to the origin over ``length``, and position inside the cell in [-1, 1]: [N, 6]."""
    relative = relative_positions(particles)
    with torch.no_grad():
        corner = torch.floor(relative / grid_size) * grid_size
    inside = (relative - corner) * (2 / grid_size) - 1
    return torch.cat([relative / length, inside], 1).to(particles.means.dtype)
