"""Which settings of a run do not go together."""

from __future__ import annotations

from gsim3d.errors import InputError
from gsim3d.plans import Plan
from gsim3d.train.config import TrainConfig


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
