"""State of a training run that goes on from machine to machine: one file of about a byte a weight.

``NAME.state.safetensors`` holds the averaged weights as int8 in blocks of 64 with a scale each (vectors in float32),
AdamW's averages of squared gradients as means over rows and columns of each matrix (Shazeer and Stern 2018,
"Adafactor"), the training curve, and as metadata what :class:`Progress` says. The next run begins at the averaged
weights, which are less noisy than those of the last step, with first moments of zero and a warm-up.
``NAME.weights.safetensors`` beside it is a checkpoint with the same weights in bfloat16, to predict with.
"""

import dataclasses
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import describe

FORMAT = 2
BLOCK = 64  # weights that share a scale
LEVELS = 127
PRIORS = "dynamics.priors."  # names of their parameters begin so
CURVE = ("step", "windows", "seconds", "loss", "past_psnr", "future_psnr", "learning_rate")


@dataclass(frozen=True)
class Progress:
    """How far a run has come."""

    step: int = 0  #: optimizer steps
    windows: int = 0  #: training windows with simulated steps
    seconds: float = 0.0  #: of training, without videos and scoring
    next_trajectory: int = 0  #: number of the first trajectory that was not handed out
    n_skipped: int = 0  #: steps that changed nothing
    needed: dict[str, Any] = field(default_factory=dict)  #: capacity of CUDA graphs, of CapturedLoss
    #: one entry a run: device, commit, seconds, steps, trajectories
    runs: list[dict[str, Any]] = field(default_factory=list)
    #: validation scores on the way, one entry a checkpoint that was scored
    scores: list[dict[str, Any]] = field(default_factory=list)
    curve: list[list[float]] = field(default_factory=list)  #: rows of CURVE, one a logged step


def state_file(folder: str | Path, name: str) -> Path:
    """Where the state of run ``name`` lies."""
    return Path(folder) / f"{name}.state.safetensors"


def weights_file(folder: str | Path, name: str) -> Path:
    """The checkpoint to predict with."""
    return Path(folder) / f"{name}.weights.safetensors"


def load_progress(folder: str | Path, name: str) -> Progress:
    """The progress of run ``name`` in ``folder``; that of a new one where there is no state.

    Raises:
        InputError: the file is damaged or of another version.
    """
    return _read(state_file(folder, name))[0] if state_file(folder, name).is_file() else Progress()


def begun_with(folder: str | Path, name: str, first: str) -> tuple[str, Progress]:
    """The run whose state run ``name`` goes on from, and the progress there: its own, or else ``first``, if not "". Of
    another world only the weights are taken.

    Raises:
        InputError: there is no state of ``first``, where it is needed, or a state is damaged.
    """
    if not first or state_file(folder, name).is_file():
        return name, load_progress(folder, name)
    if not state_file(folder, first).is_file():
        raise InputError(f"{state_file(folder, first)}: does not exist; --begin-with needs it")
    if first.partition("-")[0] != name.partition("-")[0]:
        return first, Progress()
    return first, dataclasses.replace(load_progress(folder, first), scores=[])  # which are of another model


def load_into(trainer: Trainer, folder: str | Path, name: str, *, differs: bool = False) -> Progress:
    """Weights, second moments and capacity of graphs of run ``name`` into a new trainer.

    Parameters of priors that the state's model did not have stay as they are; ``trainer.new_parameters`` names them.

    Args:
        differs: the state is of another model: all parameters that it lacks, or has in another size, stay as they are.
    Returns:
        The progress so far; of a new run, whose trainer stays as it is, where ``folder`` has no state.
    Raises:
        InputError: the state is damaged or of another model.
    """
    file = state_file(folder, name)
    if not file.is_file():
        return Progress()
    progress, tensors = _read(file)
    own = trainer.simulator.state_dict()
    try:
        if trainer.captured and progress.needed and not differs:
            trainer.captured.reserve(progress.needed)
        trainer.new_parameters = [key for key in own if not _has(tensors, key, own[key].shape)]
        if not differs and (other := [key for key in trainer.new_parameters if not key.startswith(PRIORS)]):
            raise KeyError(f"it has no {other[0]} of shape {list(own[other[0]].shape)}")
        known = own.keys() - set(trainer.new_parameters)
        weights = {key: _unpacked(tensors, key, own[key].shape) for key in known}
        trainer.simulator.load_state_dict(weights, strict=False)
        trainer.average = {key: value.clone() for key, value in trainer.simulator.state_dict().items()}
        for key, parameter in trainer.parameters.items():
            if key in known and (f"{key}.squares" in tensors or f"{key}.rows" in tensors):
                squares = _squares(tensors, key, parameter.shape)
                moments = {"step": torch.tensor(float(progress.step)), "exp_avg_sq": squares}
                trainer.optimizer.restore(parameter, {**moments, "exp_avg": torch.zeros_like(squares)})
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: the state of another model: {str(error).splitlines()[-1].strip()}") from None
    trainer.step, trainer.seconds, trainer.n_skipped = progress.step, progress.seconds, progress.n_skipped
    return progress


def save_state(trainer: Trainer, folder: str | Path, name: str, progress: Progress) -> Progress:
    """Writes the state and the checkpoint to predict with; each file appears whole and replaces the one before.

    Returns:
        ``progress`` with the trainer's step and seconds.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    done = dataclasses.replace(
        progress, step=trainer.step, seconds=round(trainer.seconds, 1), n_skipped=trainer.n_skipped
    )
    tensors: dict[str, Tensor] = {}
    for key, value in (trainer.average or trainer.simulator.state_dict()).items():
        tensors |= _packed(key, value.cpu())
    for key, parameter in trainer.parameters.items():
        if "exp_avg_sq" in (state := trainer.optimizer.state[parameter]):
            tensors |= _packed_squares(key, state["exp_avg_sq"].float().cpu())
    _write_state(state_file(folder, name), done, tensors)
    save_weights(trainer, weights_file(folder, name))
    return done


def add_scores(folder: str | Path, name: str, progress: Progress) -> None:
    """Replaces the scores in the state of run ``name`` by those of ``progress``."""
    file = state_file(folder, name)
    known, tensors = _read(file)
    _write_state(file, dataclasses.replace(known, scores=progress.scores), tensors)


def save_weights(trainer: Trainer, path: Path) -> None:
    """Writes the averaged weights in bfloat16 as a checkpoint."""
    averaged = {key: value.to(torch.bfloat16) for key, value in trainer.average.items()}
    config = describe(trainer.config, trainer.simulator.config, trainer.scenes[0], trainer.effects)
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.export(checkpoint.Checkpoint(model=averaged, config=config, state={"step": trainer.step}), path)


def _packed(key: str, value: Tensor) -> dict[str, Tensor]:
    """``key.int8`` and ``key.scales`` of a matrix, ``key`` itself of a vector or of integers."""
    if value.ndim < 2 or not value.is_floating_point():
        return {key: value}
    flat = value.float().reshape(-1)
    blocks = F.pad(flat, (0, -len(flat) % BLOCK)).view(-1, BLOCK)
    scales = (blocks.abs().amax(1) / LEVELS).to(torch.bfloat16)
    steps = scales.float()[:, None]
    rounded = torch.where(steps > 0, blocks / steps.clamp(min=torch.finfo(torch.float32).tiny), 0).round()
    levels = rounded.clamp(-LEVELS, LEVELS).to(torch.int8).view(-1)[: len(flat)]
    return {f"{key}.int8": levels, f"{key}.scales": scales}


def _has(tensors: dict[str, Tensor], key: str, shape: torch.Size) -> bool:
    levels = tensors.get(f"{key}.int8")
    return tensors[key].shape == shape if key in tensors else levels is not None and levels.numel() == shape.numel()


def _unpacked(tensors: dict[str, Tensor], key: str, shape: torch.Size) -> Tensor:
    if f"{key}.int8" not in tensors:
        return tensors[key]
    levels = tensors[f"{key}.int8"].float()
    blocks = F.pad(levels, (0, -len(levels) % BLOCK)).view(-1, BLOCK)
    return (blocks * tensors[f"{key}.scales"].float()[:, None]).view(-1)[: len(levels)].view(shape)


def _packed_squares(key: str, value: Tensor) -> dict[str, Tensor]:
    """Means over the rows and columns of a matrix, ``value`` itself of a vector."""
    if value.ndim < 2:
        return {f"{key}.squares": value}
    matrix = value.flatten(1)
    return {f"{key}.rows": matrix.mean(1), f"{key}.columns": matrix.mean(0)}


def _squares(tensors: dict[str, Tensor], key: str, shape: torch.Size) -> Tensor:
    if f"{key}.squares" in tensors:
        return tensors[f"{key}.squares"]
    rows, columns = tensors[f"{key}.rows"], tensors[f"{key}.columns"]
    mean = rows.mean().clamp(min=torch.finfo(torch.float32).tiny)
    return (rows[:, None] * (columns / mean)).view(shape)


def _read(file: Path) -> tuple[Progress, dict[str, Tensor]]:
    try:
        tensors = safetensors.torch.load_file(file)
        with safetensors.safe_open(file, "pt") as opened:
            metadata = opened.metadata() or {}
        if metadata.get("format") != str(FORMAT):
            raise ValueError("another version of the format")
        curve = tensors.pop("curve").tolist()
        return Progress(**json.loads(metadata["progress"]), curve=curve), tensors
    except (safetensors.SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file}: not the state of a run: {error}; bring back a whole copy") from None


def _write_state(file: Path, progress: Progress, tensors: dict[str, Tensor]) -> None:
    known = {key: value for key, value in dataclasses.asdict(progress).items() if key != "curve"}
    metadata = {"format": str(FORMAT), "progress": json.dumps(known)}
    curve = torch.tensor(progress.curve, dtype=torch.float64).reshape(-1, len(CURVE))
    contiguous = {key: value.contiguous() for key, value in {**tensors, "curve": curve}.items()}
    part = file.with_name(f".{file.name}.part")
    part.write_bytes(safetensors.torch.save(contiguous, metadata))
    os.replace(part, file)
