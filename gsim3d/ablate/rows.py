"""The rows of the paper's ablations: each declared once, as a change of a training run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from gsim3d.errors import InputError, did_you_mean
from gsim3d.train.config import LossConfig, OptimizerConfig, TrainConfig
from gsim3d.train.restore import model_config

Change = Callable[[TrainConfig], TrainConfig]
HISTORY = 4  # of the paper's runs
# Of base runs of the presets that are small enough for many of them: what makes short runs learn, and nothing that a
# CUDA graph cannot repeat.
DRAWS_NOTHING = {"dynamics": {"drop_path": 0.0, "shuffle_orders": False}}
SHORT = {"tiny": 1e-3, "small": 5e-4}  # learning rates
DEFAULT_ROWS = ("latent", "explicit", "no-tem")


@dataclass(frozen=True)
class Row:
    """differs: from the base run, in words.   paper: the published PSNR [dB] where known, and what is odd in it."""

    name: str
    differs: str
    change: Change
    paper: str = ""


def base_run(preset: str = "tiny") -> TrainConfig:
    """The run that rows change where none is given: the paper's history, views and horizon as far as the preset
    goes."""
    config = TrainConfig(preset=preset)
    history = min(HISTORY, 2 ** model_config(config).dynamics.history_bits)
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, history=history))
    if preset not in SHORT:
        return config
    phase = partial(dataclasses.replace, batch=2, target_views=3, learning_rate=SHORT[preset])
    return dataclasses.replace(
        config,
        model=DRAWS_NOTHING,
        data=dataclasses.replace(config.data, background_stride=2, targets_apart=True),
        phases=tuple(phase(part) for part in config.phases),
        loss=LossConfig(body_weight=2.0),
        optimizer=OptimizerConfig(clip_norm=1.0, ema_decay=0.98),
        captured=True,
    )


def with_steps(config: TrainConfig, n_steps: int) -> TrainConfig:
    """The run in ``n_steps`` optimizer steps, shared by its phases as before. Raises InputError: they are too few."""
    if n_steps < len(config.phases):
        raise InputError(f"--steps: must be at least {len(config.phases)}, one for each phase; got {n_steps}")
    before = config.n_steps
    counts = [max(1, n_steps * phase.steps // before) for phase in config.phases]
    counts[counts.index(max(counts))] += n_steps - sum(counts)
    phases = [dataclasses.replace(phase, steps=count) for phase, count in zip(config.phases, counts, strict=True)]
    return dataclasses.replace(config, phases=tuple(phases))


def merged(settings: dict, changes: dict) -> dict:
    """Nested settings with changes."""
    result = dict(settings)
    for name, value in changes.items():
        before = result.get(name)
        result[name] = merged(before, value) if isinstance(value, dict) and isinstance(before, dict) else value
    return result


def _same(config: TrainConfig) -> TrainConfig:
    return config


def _model(**parts: dict[str, Any]) -> Change:
    return lambda config: dataclasses.replace(config, model=merged(config.model, parts))


def _explicit(config: TrainConfig) -> TrainConfig:
    base = model_config(config)
    static, degree = base.encoder.static_dim // 2, base.renderer.sh_degree
    return _model(
        encoder={"explicit": True, "dynamic_dim": 0, "static_dim": static, "sh_degree": degree},
        dynamics={
            "explicit": True,
            "dynamic_latents": 0,
            "static_latents": static,
            "sh_degree": degree,
            "scale_min": base.renderer.scale_min,
            "scale_max": base.renderer.scale_max,
        },
        renderer={"latents": 0},
    )(config)


def _grid(factor: float) -> Change:
    return lambda config: _model(dynamics={"grid_size": factor * model_config(config).dynamics.grid_size})(config)


def _rollout(n: int) -> Change:
    def change(config: TrainConfig) -> TrainConfig:
        phases = [dataclasses.replace(phase, horizon=n) if phase.horizon else phase for phase in config.phases]
        return dataclasses.replace(config, phases=tuple(phases))

    return change


def _history(n: int) -> Change:
    def change(config: TrainConfig) -> TrainConfig:
        data = dataclasses.replace(config.data, history=n, shortest_history=min(n, config.data.shortest_history))
        phases = [dataclasses.replace(phase, history=0) if phase.horizon else phase for phase in config.phases]
        bits = max(model_config(config).dynamics.history_bits, (n - 1).bit_length())
        changed = dataclasses.replace(config, data=data, phases=tuple(phases))
        return _model(dynamics={"history_bits": bits})(changed)

    return change


def _views(n: int) -> Change:
    def change(config: TrainConfig) -> TrainConfig:
        fewest = min(n, config.data.fewest_views)
        data = dataclasses.replace(config.data, context_views=n, fewest_views=fewest)
        return dataclasses.replace(config, data=data)

    return change


def _background(kind: str) -> Change:
    changes = {"dynamics": {"background": kind}}
    return lambda config: dataclasses.replace(config, effects=merged(config.effects, changes))


ROWS = {
    row.name: row
    for row in (
        Row("latent", "the base run", _same, "33.15"),
        Row("explicit", "particles carry their own Gaussians, half the static latents, no dynamic ones", _explicit),
        Row(
            "no-tem",
            "no time embedding where steps are merged",
            _model(dynamics={"time_embedding": False}),
            "18.19 (supplement: 25.07)",
        ),
        Row("rollout-1", "trained over 1 simulated step", _rollout(1)),
        Row("rollout-2", "trained over 2 simulated steps", _rollout(2)),
        Row("rollout-4", "trained over 4 simulated steps", _rollout(4)),
        Row("rollout-12", "trained over 12 simulated steps", _rollout(12), "33.15"),
        Row("history-1", "1 step of history", _history(1), "22.9 (changed at test time)"),
        Row("history-2", "2 steps of history", _history(2), "27.3 (changed at test time)"),
        Row("history-4", "4 steps of history", _history(4), "33.15"),
        Row("grid-half", "cells of half the size", _grid(0.5), "25.4"),
        Row("grid-double", "cells of twice the size", _grid(2.0), "25.4"),
        Row("views-1", "1 input view", _views(1)),
        Row("views-2", "2 input views", _views(2)),
        Row("views-3", "3 input views", _views(3), "31.60 (text: 33.15)"),
        Row("background-frozen", "the background never moves, others see it", _background("frozen")),
        Row("background-dynamic", "every particle may move", _background("dynamic")),
        Row("background-masked", "the background is left out", _background("masked_out")),
        Row("calls-1", "1 step a call of the network", _model(dynamics={"steps_per_call": 1}), "33.15"),
        Row("calls-2", "2 steps a call of the network", _model(dynamics={"steps_per_call": 2}), "32.59"),
        Row(
            "calls-4",
            "4 steps a call of the network, from the newest of the history",
            _model(dynamics={"steps_per_call": 4}),
            "31.98 (text: 32.27), from all 4 steps of it",
        ),
    )
}


def rows_named(names: str) -> list[Row]:
    """Rows from their names with commas between. Raises InputError for an unknown or repeated name, or none."""
    found = [name.strip() for name in names.split(",")]
    if unknown := [name for name in found if name not in ROWS]:
        raise InputError(
            f"--rows: {unknown[0]!r} does not exist; rows: {', '.join(ROWS)}{did_you_mean(unknown[0], ROWS)}"
        )
    if len(set(found)) < len(found):
        raise InputError(f"--rows: a row is named twice in {names!r}")
    return [ROWS[name] for name in found]
