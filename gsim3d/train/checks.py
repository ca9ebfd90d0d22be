"""Which settings of a run do not go together."""

from __future__ import annotations

from pathlib import Path

from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError
from gsim3d.train.config import TrainConfig
from gsim3d.train.settings import from_dict, to_dict

# May change between two sittings of one run without changing the curve; so may the number of workers, if there are any.
FREE_SETTINGS = ("captured", "checkpoint_every", "keep_checkpoints", "log_every", "recompute")
# May change as well, so that a run which diverged can go on; the curve is another one from there on.
FREE_OF_OPTIMIZER, FREE_OF_STAGES = ("clip_norm", "max_skipped"), ("learning_rate", "warm_up")


def check_sharing(config: TrainConfig, n_processes: int, norm: str) -> None:
    if config.workers and norm == "batch":
        raise InputError("workers: must be 0 for a model with batch normalisation, which needs all samples at once")
    if config.captured and config.workers:
        raise InputError("captured: needs workers 0")
    if config.workers and n_processes > 1:
        raise InputError(f"workers: must be 0 in {n_processes} processes, which share the samples of a step themselves")
    for name in ("stages", "in_turn"):
        for i, stage in enumerate(getattr(config, name)):
            if stage.batch < n_processes:
                raise InputError(f"{name}[{i}].batch: {stage.batch} samples are too few for {n_processes} processes")


def check_history(config: TrainConfig, plan: Plan) -> None:
    for history in {config.data.history, *(stage.history for stage in config.all_stages if stage.horizon)}:
        if history > plan.history:
            raise InputError(f"data.history: {history} steps, but this model sees up to {plan.history}")


def check_same_run(config: TrainConfig, saved: dict, out: Path) -> None:
    """Raises InputError where the run in ``out``, whose settings are ``saved``, was started with another ``config``."""
    before = to_dict(from_dict(TrainConfig, dict(saved), base=config))
    before, now = _fixed_settings(before), _fixed_settings(to_dict(config))
    for name in now:
        if name not in FREE_SETTINGS and before.get(name) != now[name]:
            raise InputError(f"{out}: was started with another {name!r}; use the same or another folder")


def _fixed_settings(settings: dict) -> dict:
    """Of a run's settings those that must stay, as far as parts of them may change."""
    fixed = {**settings, "workers": bool(settings.get("workers"))}
    parts_of = {"optimizer": FREE_OF_OPTIMIZER, "stages": FREE_OF_STAGES, "in_turn": FREE_OF_STAGES}
    for name, free in parts_of.items():
        parts = settings.get(name) or []
        kept = [
            {k: v for k, v in part.items() if k not in free} for part in ([parts] if name == "optimizer" else parts)
        ]
        fixed[name] = kept
    return fixed
