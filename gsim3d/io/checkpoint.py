"""Checkpoints: folders that appear whole, a pointer to the last good one, and a single file to ship.

A run folder holds ``checkpoints/step_000500/`` and ``checkpoints/last`` (the name of the newest good folder). A
checkpoint folder holds

- ``model.safetensors``, ``ema.safetensors`` (float32 weights; the second averaged, absent without averaging),
- ``optimizer.safetensors`` (moments by parameter name; absent when the weights only were saved),
- ``config.yaml`` (model, data, effects, training),
- ``state.json`` (step, next sample, versions, hash of every file and of its own content, hash of the checkpoint it
  continued). One without a hash of its own, as earlier versions wrote it, is read as it is.

Nothing here is a pickle: reading a checkpoint runs no code.
"""

import hashlib
import json
import os
import platform
import shutil
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import yaml
from safetensors.torch import load_file
from torch import Tensor

from gsim3d import __version__
from gsim3d.errors import InputError, NumericalError
from gsim3d.io.files import MAX_TEXT, read_file, read_yaml, sha256_of, write_whole
from gsim3d.io.plain import is_number
from gsim3d.pretrained import located

FORMAT = 1
STATE, CONFIG, POINTER = "state.json", "config.yaml", "last"
_WEIGHTS = {"model": "model.safetensors", "ema": "ema.safetensors", "optimizer": "optimizer.safetensors"}
MAX_STATE = 16 * 2**20  # bytes: of the names of many scenes
OWN_HASH = "sha256_of_state"


def _is_count(value: Any) -> bool:
    return is_number(value, int) and value >= 0


def _is_time(value: Any) -> bool:
    return is_number(value, float) and value >= 0


def _are_texts(values: Any) -> bool:
    return isinstance(values, (list, tuple)) and all(isinstance(value, str) for value in values)


def _is_scale(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and len(value) == 2 and _is_time(value[0]) and _is_count(value[1])


_COUNTS = ("step", "next_sample", "n_skipped", "n_skipped_in_a_row")
_STATE_VALUES = {
    **dict.fromkeys(_COUNTS, (_is_count, "a whole number of at least 0")),
    "seconds": (_is_time, "a number of at least 0"),
    "loss_scale": (_is_scale, "a number and a count"),
    "scenes": (_are_texts, "names"),
    "parent": (lambda value: value is None or isinstance(value, str), "a hash"),
    "sha256": (lambda value: isinstance(value, dict) and _are_texts(list(value.values())), "hashes by file"),
}


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds."""

    model: dict[str, Tensor]  #: tensors by name; ema and optimizer may be empty
    config: dict[str, Any]  #: the content of config.yaml: format, model, data, effects, train
    #: step, next_sample, and what else resuming needs; plain JSON values
    state: dict[str, Any] = field(default_factory=dict)
    ema: dict[str, Tensor] = field(default_factory=dict)  #: tensors by name, or empty
    optimizer: dict[str, Tensor] = field(default_factory=dict)  #: tensors by name, or empty
    digest: str | None = None  #: hash that names this checkpoint; None before it is written

    @property
    def weights(self) -> dict[str, Tensor]:
        """The weights to predict with: averaged ones where there are any."""
        return self.ema or self.model


def save(run: str | Path, checkpoint: Checkpoint, keep: int = 2) -> Path:
    """Writes the checkpoint into the run folder, points to it, and removes all but the ``keep`` newest.

    A process that is killed at any moment leaves the previous checkpoint good and pointed to.

    Raises:
        NumericalError: weights that are not finite; the previous checkpoint stays.
        InputError: the disk is full, or the folder cannot be written; the previous checkpoint stays as well.
    """
    root = Path(run) / "checkpoints"
    folder = root / f"step_{checkpoint.state['step']:06d}"
    try:
        root.mkdir(parents=True, exist_ok=True)
        write(folder, checkpoint)
        _write_text(root / POINTER, folder.name)
    except OSError as error:
        advice = "checkpoints before it are untouched: make room and train again, it goes on from the last one"
        raise InputError(f"{folder}: cannot be written: {error.strerror}; {advice}") from None
    for old in sorted(root.glob("step_*"))[:-keep]:
        if old != folder:
            shutil.rmtree(old, ignore_errors=True)
    return folder


def write(folder: Path, checkpoint: Checkpoint) -> Path:
    """Writes a checkpoint folder, whole or not at all; one that is there is replaced."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        _write_files(part, checkpoint)
    except (OSError, NumericalError):
        shutil.rmtree(part, ignore_errors=True)  # it may be what fills the disk
        raise
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(part, folder)
    return folder


def _write_files(part: Path, checkpoint: Checkpoint) -> None:
    part.mkdir()
    for name, file in _WEIGHTS.items():
        tensors = getattr(checkpoint, name)
        if tensors:
            (part / file).write_bytes(_bytes_of(tensors))
    (part / CONFIG).write_text(yaml.safe_dump({"format": FORMAT, **checkpoint.config}, sort_keys=False))
    state = {
        **checkpoint.state,
        "versions": {"gsim3d": __version__, "torch": str(torch.__version__), "python": platform.python_version()},
        "sha256": {path.name: sha256_of(path) for path in sorted(part.iterdir())},
    }
    (part / STATE).write_text(json.dumps({**state, OWN_HASH: hash_of_state(state)}, indent=1))
    for path in [*part.iterdir(), part]:
        _sync(path)


def exists(run: str | Path) -> bool:
    """Whether the run folder has a checkpoint to go on from."""
    return (Path(run) / "checkpoints" / POINTER).is_file()


def digest_of(folder: Path) -> str:
    """The hash that names the checkpoint in ``folder``: that of its state, which holds the hashes of all its files."""
    return sha256_of(folder / STATE)


def load(path: str | Path) -> Checkpoint:
    """Reads a run folder (its last good checkpoint), a checkpoint folder, a single exported file, or the simulator of
    this name that comes with gsim3d.

    Raises:
        InputError: it is none of these, or a file is missing, truncated or changed; the message names it, and of a run
            folder the newest checkpoint that is whole.
    """
    try:
        return _load(located(path))
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: the checkpoint cannot be read: {error or 'no memory'}") from None


def _load(path: Path) -> Checkpoint:
    if path.is_file():
        return _load_single(path)
    pointer = path / "checkpoints" / POINTER
    if not pointer.is_file():
        return _load_folder(path)
    try:
        return _load_folder(pointer.parent / Path(read_file(pointer, MAX_TEXT).decode(errors="replace").strip()).name)
    except InputError as error:
        for older in sorted(pointer.parent.glob("step_*"), reverse=True):
            with suppress(InputError):
                _load_folder(older)
                advice = f"{older.name} beside it is whole: write this name into {pointer} to go on from there"
                break
        else:
            raise
        raise InputError(f"{error}; {advice}") from None


def _load_folder(path: Path) -> Checkpoint:
    if not (path / STATE).is_file():
        raise InputError(f"{path}: not a checkpoint (a run folder, a folder with {STATE}, or a .safetensors file)")
    try:
        state = json.loads(read_file(path / STATE, MAX_STATE))
    except (ValueError, RecursionError):
        raise InputError(f"{path / STATE}: not a checkpoint's state, the checkpoint is broken") from None
    hashes = _checked_state(state, path / STATE).get("sha256", {})
    if state.pop(OWN_HASH, None) not in (None, hash_of_state(state)):
        raise InputError(f"{path / STATE}: changed since it was written")
    for name, expected in hashes.items():
        file = path / Path(name).name
        if not file.is_file() or not _may_be_whole(file) or sha256_of(file) != expected:
            raise InputError(f"{file}: missing, truncated or changed since it was written")
    if not {CONFIG, _WEIGHTS["model"]} <= set(hashes):
        raise InputError(f"{path}: the checkpoint holds no {CONFIG} or no {_WEIGHTS['model']}")
    config = _known_format(read_yaml(path / CONFIG), path / CONFIG)
    tensors = {name: _read_tensors(path / file) if file in hashes else {} for name, file in _WEIGHTS.items()}
    return Checkpoint(config=config, state=state, digest=digest_of(path), **tensors)


def _may_be_whole(file: Path) -> bool:
    """Whether it is worth to hash a file, which takes seconds a gigabyte."""
    if file.suffix != ".safetensors":
        return file.stat().st_size <= MAX_TEXT
    try:
        with safetensors.safe_open(file, "pt"):
            return True
    except (safetensors.SafetensorError, OSError):
        return False


def hash_of_state(state: dict[str, Any]) -> str:
    """The hash of a state's content without its own hash."""
    return hashlib.sha256(json.dumps(state, sort_keys=True).encode()).hexdigest()


def _checked_state(state: Any, where: Path) -> dict[str, Any]:
    """``state``, whose known values have their types. Raises InputError that names the first that has not."""
    if not isinstance(state, dict):
        raise InputError(f"{where}: a checkpoint's state must be a mapping")
    for name, (fits, wanted) in _STATE_VALUES.items():
        if name in state and not fits(state[name]):
            raise InputError(f"{where}: {name} must be {wanted}; the checkpoint is broken")
    if "step" not in state:
        raise InputError(f"{where}: step is missing; the checkpoint is broken")
    return state


def export(checkpoint: Checkpoint, path: str | Path) -> None:
    """Writes the weights to predict with as one .safetensors file whose metadata holds config and state."""
    path = Path(path)
    if path.suffix != ".safetensors":
        raise InputError(f"{path}: a single-file checkpoint must end in .safetensors")
    metadata = {
        "gsim3d_config": json.dumps({"format": FORMAT, **checkpoint.config}),
        "gsim3d_state": json.dumps({"step": checkpoint.state.get("step", 0), "parent": checkpoint.digest}),
    }
    write_whole(path, _bytes_of(checkpoint.weights, metadata))


def _bytes_of(tensors: dict[str, Tensor], metadata: dict[str, str] | None = None) -> bytes:
    """A .safetensors file. (Its own writer makes files that other users may not read.)

    Raises NumericalError where a tensor is not finite.
    """
    if name := first_not_finite(tensors):
        advice = "nothing is written: lower the learning rate and go on from the last checkpoint"
        raise NumericalError(f"{name}: holds numbers that are not finite; {advice}", tensor=name)
    return safetensors.torch.save({k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}, metadata)


def first_not_finite(tensors: dict[str, Tensor | None]) -> str | None:
    """Returns the name of the first tensor that is not finite; None if all are finite or None."""
    floating = ((name, value) for name, value in tensors.items() if value is not None and value.is_floating_point())
    return next((name for name, value in floating if not bool(value.isfinite().all())), None)


def _load_single(path: Path) -> Checkpoint:
    try:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
        config, state = json.loads(metadata["gsim3d_config"]), json.loads(metadata["gsim3d_state"])
    except (safetensors.SafetensorError, KeyError, ValueError, RecursionError):
        raise InputError(f"{path}: truncated, or not a gsim3d checkpoint file (see gsim3d import --help)") from None
    config, state = _known_format(config, path), _checked_state(state, path)
    return Checkpoint(model=_read_tensors(path), config=config, state=state, digest=sha256_of(path))


def _known_format(config: dict, where: Path) -> dict:
    if not isinstance(config, dict):
        raise InputError(f"{where}: a checkpoint's configuration must be a mapping")
    if config.get("format") != FORMAT:
        found = str(config["format"])[:20] if isinstance(config.get("format"), (int, str)) else "unknown"
        raise InputError(f"{where}: checkpoint format {found}; this version reads {FORMAT}")
    missing = [name for name in ("model", "data") if not isinstance(config.get(name), dict)]
    if missing:
        raise InputError(f"{where}: the section {missing[0]} is missing")
    return {name: value for name, value in config.items() if name != "format"}


def _read_tensors(path: Path) -> dict[str, Tensor]:
    try:
        tensors = load_file(path)
    except (safetensors.SafetensorError, OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read: {' '.join(str(error).split())[:300]}") from None
    if name := first_not_finite(tensors):
        raise InputError(f"{path}: {name} holds numbers that are not finite: the weights are broken")
    return tensors


def _write_text(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text)
    _sync(part)
    os.replace(part, path)


def _sync(path: Path) -> None:
    """The data reaches the disk before the rename that makes it visible."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def laid_out_as(weight: Tensor, value: Tensor) -> Tensor:
    """``value`` with device and strides of ``weight``: few kernels update tensors that are alike, else one for each.

    Raises ValueError where their shapes differ.
    """
    if value.shape != weight.shape:
        raise ValueError(f"a tensor of shape {tuple(value.shape)} instead of {tuple(weight.shape)}")
    if value.stride() == weight.stride() and value.device == weight.device:
        return value
    return torch.empty_like(weight, dtype=value.dtype, requires_grad=False).copy_(value)
