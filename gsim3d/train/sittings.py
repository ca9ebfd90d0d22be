"""A training run in sittings of given length on machines that keep nothing: what travels from one to the next.

A state folder holds, of a model called NAME,

- ``NAME.json``: step, next trajectory, what every sitting did, names and hashes of the other files;
- ``NAME.STEP.weights.safetensors``: the averaged weights in bfloat16 with their configuration, a checkpoint to predict
  with;
- ``NAME.STEP.difference.safetensors``: the weights themselves minus these, in bfloat16;
- ``NAME.STEP.squares.safetensors``: AdamW's averages of squared gradients, in bfloat16;
- ``NAME.metrics.jsonl``: the log.

Six bytes a weight instead of the sixteen of a checkpoint. What is lost: the weights are rounded by 2^-9 of their size,
and the averages of gradients begin at zero, so that the first ten steps or so are shorter. So a run in sittings is
not the one that was never stopped, bit by bit, as one of ``gsim3d train`` is.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.state import MOTION_CHANNELS
from gsim3d.errors import InputError
from gsim3d.files import MAX_TEXT, read_file, sha256_of
from gsim3d.train import checkpoint
from gsim3d.train.log import LOG
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import describe, restore

FORMAT = 1
SEEN = "dynamics.net.stem.conv.weight"  # what the network reads of motion are its last columns
TOLD = "dynamics.net.stem.told.weight"
LIGHTS, DIMMING, STRENGTH = "dynamics.lights", "dynamics.dimming", "dynamics.strength"
GRAVITY, FRICTION, SKIN = "dynamics.gravity", "dynamics.friction", "dynamics.skin"
PREDICTED = ("dynamics.net.head.fc2.weight", "dynamics.net.head.fc2.bias")
PLACES = 3  # rows that predict places where no motion is seen
WEIGHTS, DIFFERENCE, SQUARES = "weights", "difference", "squares"


@dataclass(frozen=True)
class Progress:
    """How far a run has come.

    step: optimizer steps done.   next_trajectory: number of the first one that was not begun to be filmed.
    seconds: of training, of all sittings.   n_skipped: steps that changed nothing.
    sittings: what each of them did, as written by the tool.   files: name -> sha256.
    needed: room of graphs, of CapturedLoss: making one again takes half a minute where rollouts are long.
    """

    step: int = 0
    next_trajectory: int = 0
    seconds: float = 0.0
    n_skipped: int = 0
    sittings: list[dict[str, Any]] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    needed: dict[str, Any] = field(default_factory=dict)


def load_progress(folder: str | Path, name: str) -> Progress:
    """The progress of run ``name`` in ``folder``; that of a new one where there is none.

    Raises:
        InputError: it cannot be read, or a file is missing, cut off or changed.
    """
    file = Path(folder) / f"{name}.json"
    if not file.is_file():
        return Progress()
    try:
        content = json.loads(read_file(file, MAX_TEXT))
        if content.pop("format") != FORMAT:
            raise ValueError("another version of the format")
        progress = Progress(**content)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file}: not the state of a run: {error}") from None
    for part, digest in progress.files.items():
        path = file.parent / Path(part).name
        if not path.is_file() or sha256_of(path) != digest:
            raise InputError(f"{path}: missing, cut off or changed since it was written")
    return progress


def load_into(trainer: Trainer, folder: str | Path, name: str, progress: Progress) -> None:
    """Weights, averages and moments of the run's last sitting into a new trainer, and what its graphs needed; its log
    into the trainer's folder."""
    folder = Path(folder)
    trainer.out.mkdir(parents=True, exist_ok=True)
    log = folder / f"{name}.{LOG}"
    if log.is_file() and log.resolve() != (trainer.out / LOG).resolve():
        shutil.copyfile(log, trainer.out / LOG)
    if trainer.captured and progress.needed:
        try:
            trainer.captured.make_room(progress.needed)
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{folder / name}.json: needed must be the room that graphs of this model had") from None
    if not progress.step:
        return
    averaged, difference, squares = (
        {key: value.float() for key, value in _read(folder, progress, part).items()}
        for part in (WEIGHTS, DIFFERENCE, SQUARES)
    )
    try:
        trainer.simulator.load_state_dict({key: value + difference[key] for key, value in averaged.items()})
        weights = trainer.simulator.state_dict()
        trainer.average = {key: checkpoint.laid_out_as(weights[key], value) for key, value in averaged.items()}
        for key, value in squares.items():
            parameter, step = trainer.parameters[key], torch.tensor(float(progress.step))
            moments = {"step": step, "exp_avg": torch.zeros_like(parameter), "exp_avg_sq": value}
            trainer.optimizer.restore(parameter, moments)
    except (RuntimeError, KeyError) as error:
        raise InputError(
            f"{folder}: the state of {name} is of another model: {str(error).splitlines()[-1].strip()}"
        ) from None
    trainer.step, trainer.seconds, trainer.n_skipped = progress.step, progress.seconds, progress.n_skipped
    trainer.log.cut(trainer.step)


def begin_with(trainer: Trainer, path: str | Path) -> dict[str, Any]:
    """Weights of a trained simulator into a new trainer, whose dynamics may see more (motion, waves, contacts,
    velocities, deformations, lights) than the other's: what reads it begins at zero, and so does what predicts shares
    of motions and light; where motion is new all that predicts positions, which are others then. New lights
    and those that begin to light surfaces begin as in any new trainer, and so does what is read and predicted of them.

    Returns:
        The checkpoint's name, digest and step.
    Raises:
        InputError: it is a simulator of other sizes.
    """
    other = restore(path)
    own = {key: value.cpu() for key, value in trainer.simulator.state_dict().items()}
    saved, before = other.checkpoint, dict(other.simulator.dynamics.layout.outputs)
    given = {key: value.float() for key, value in saved.model.items()}
    if SEEN in given and given[SEEN].shape[-1] == own[SEEN].shape[-1] - MOTION_CHANNELS:
        given[SEEN] = F.pad(given[SEEN], (0, MOTION_CHANNELS))
    was_told, told = (dict(simulator.dynamics.layout.told) for simulator in (other.simulator, trainer.simulator))
    if not was_told.items() <= told.items():
        raise InputError(f"{path}: a simulator of other sizes: its dynamics is told {was_told}, this one {told}")
    anew = set()  # fields whose meaning is another one: what is read and predicted of them
    if STRENGTH in own and STRENGTH not in given:
        anew |= {"lights", "light"}
        given = {key: value for key, value in given.items() if key not in (LIGHTS, DIMMING)}
    if FRICTION in own and FRICTION not in given:
        anew.add("means")
    if told:
        given[TOLD] = _told(given.get(TOLD), was_told, told, own[TOLD], anew)
    for key in (LIGHTS, DIMMING, STRENGTH, GRAVITY, FRICTION, SKIN):
        if key in own:
            given.setdefault(key, own[key])
    after = dict(trainer.simulator.dynamics.layout.outputs)
    for key in PREDICTED:
        if before.keys() <= after.keys() and len(given[key]) == sum(before.values()):  # else of other sizes
            parts = dict(zip(before, given[key].split(list(before.values())), strict=True))
            parts = {name: rows for name, rows in parts.items() if name not in anew}
            given[key] = torch.cat([_widened(name, parts.get(name, given[key][:0]), n) for name, n in after.items()])
    try:
        trainer.simulator.load_state_dict(given)
    except RuntimeError as error:
        raise InputError(f"{path}: a simulator of other sizes: {str(error).splitlines()[-1].strip()}") from None
    weights = trainer.simulator.state_dict()
    trainer.average = {key: value.detach().clone() for key, value in weights.items()}
    return {"name": str(path), "digest": saved.digest, "step": saved.state["step"]}


def _told(
    given: Tensor | None, before: dict[str, int], after: dict[str, int], like: Tensor, anew: Collection[str]
) -> Tensor:
    """Weights of what rows are told ``after``, [C, channels] each, padded as ``like``: those of what they were told
    ``before``, and 0 of what is new or ``anew``."""
    parts = {}
    if given is not None:
        parts = dict(zip(before, given.split([*before.values(), given.shape[1] - sum(before.values())], 1)))
    parts = {name: columns for name, columns in parts.items() if name not in anew}
    columns = torch.cat([parts.get(name, like.new_zeros(len(like), n)) for name, n in after.items()], 1)
    return F.pad(columns, (0, like.shape[1] - columns.shape[1]))


def _widened(name: str, rows: Tensor, n: int) -> Tensor:
    """The ``n`` rows that predict a field, from those of a dynamics that sees less."""
    if name == "means" and len(rows) == PLACES < n:  # without motion, which goes on now
        rows = rows[:0]
    return torch.cat([rows, rows.new_zeros(max(0, n - len(rows)), *rows.shape[1:])])


def save_state(trainer: Trainer, folder: str | Path, name: str, progress: Progress) -> Progress:
    """Writes the state; one that was there stays good until the new one is whole, and is removed then."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    start = f"{name}.{trainer.step:06d}"
    averaged = {key: value.to(torch.bfloat16) for key, value in trainer.average.items()}
    config = describe(trainer.config, trainer.simulator.config, trainer.scenes[0], trainer.plan_spec)
    saved = checkpoint.Checkpoint(model=averaged, config=config, state={"step": trainer.step})
    weights = folder / f"{start}.{WEIGHTS}.safetensors"
    checkpoint.export(saved, weights)
    states = {key: trainer.optimizer.state[parameter] for key, parameter in trainer.parameters.items()}
    squares = {key: state["exp_avg_sq"] for key, state in states.items() if "exp_avg_sq" in state}
    parts = {
        DIFFERENCE: {key: value - averaged[key].float() for key, value in trainer.simulator.state_dict().items()},
        SQUARES: squares,
    }
    files = {weights.name: sha256_of(weights)}
    for part, tensors in parts.items():
        path = folder / f"{start}.{part}.safetensors"
        _write(path, safetensors.torch.save({k: v.to("cpu", torch.bfloat16).contiguous() for k, v in tensors.items()}))
        files[path.name] = sha256_of(path)
    if (log := trainer.out / LOG).is_file():
        _write(folder / f"{name}.{LOG}", log.read_bytes())
    done = dataclasses.replace(
        progress, step=trainer.step, seconds=round(trainer.seconds, 1), n_skipped=trainer.n_skipped, files=files
    )
    _write(folder / f"{name}.json", json.dumps({"format": FORMAT, **dataclasses.asdict(done)}, indent=1).encode())
    for old in folder.glob(f"{name}.*.safetensors"):
        if old.name not in files:
            old.unlink()
    return done


def weights_file(folder: str | Path, progress: Progress) -> Path:
    """The checkpoint to predict with."""
    return Path(folder) / _named(progress, WEIGHTS)


def _named(progress: Progress, part: str) -> str:
    return next(name for name in progress.files if name.endswith(f".{part}.safetensors"))


def _read(folder: Path, progress: Progress, part: str) -> dict[str, Tensor]:
    return safetensors.torch.load_file(folder / _named(progress, part))


def _write(path: Path, content: bytes) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(content)
    os.replace(part, path)
