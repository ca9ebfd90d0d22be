"""Checkpoints: folders that appear whole, a pointer to the last good one, and a single file to ship.

A run folder holds ``checkpoints/step_000500/`` and ``checkpoints/last`` (the name of the newest good folder). A
checkpoint folder holds

- ``model.safetensors``, ``ema.safetensors`` (float32 weights; the second averaged, absent without averaging),
- ``optimizer.safetensors`` (moments by parameter name; absent when the weights only were saved),
- ``config.yaml`` (model, data, effects, training),
- ``state.json`` (step, next sample, versions, hash of every file, hash of the checkpoint it continued).

Nothing here is a pickle: reading a checkpoint runs no code.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import yaml
from safetensors.torch import load_file
from torch import Tensor

from gsim3d import __version__
from gsim3d.errors import InputError
from gsim3d.files import MAX_TEXT, read_file, sha256_of
from gsim3d.pretrained import located
from gsim3d.train.settings import load_yaml

FORMAT = 1
STATE, CONFIG, POINTER = "state.json", "config.yaml", "last"
_WEIGHTS = {"model": "model.safetensors", "ema": "ema.safetensors", "optimizer": "optimizer.safetensors"}


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds.

    model, ema, optimizer: tensors by name; ema and optimizer may be empty.
    config: the content of config.yaml: format, model, data, effects, train.
    state: step, next_sample, and what else resuming needs; plain JSON values.
    digest: hash that names this checkpoint; None before it is written.
    """

    model: dict[str, Tensor]
    config: dict[str, Any]
    state: dict[str, Any] = field(default_factory=dict)
    ema: dict[str, Tensor] = field(default_factory=dict)
    optimizer: dict[str, Tensor] = field(default_factory=dict)
    digest: str | None = None

    @property
    def weights(self) -> dict[str, Tensor]:
        """The weights to predict with: averaged ones where there are any."""
        return self.ema or self.model


def save(run: str | Path, checkpoint: Checkpoint, keep: int = 2) -> Path:
    """Writes the checkpoint into the run folder, points to it, and removes all but the ``keep`` newest.

    A process that is killed at any moment leaves the previous checkpoint good and pointed to.

    Raises:
        InputError: the disk is full, or the folder cannot be written; the previous checkpoint stays as well.
    """
    root = Path(run) / "checkpoints"
    folder = root / f"step_{checkpoint.state['step']:06d}"
    try:
        root.mkdir(parents=True, exist_ok=True)
        write(folder, checkpoint)
        _write_text(root / POINTER, folder.name)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written: {error.strerror}; checkpoints before it are untouched: make room and train "
            "again, it goes on from the last one"
        ) from None
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
    except OSError:
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
    (part / STATE).write_text(json.dumps(state, indent=1))
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
            if _is_whole(older):
                advice = f"{older.name} beside it is whole: write this name into {pointer} to go on from there"
                raise InputError(f"{error}; {advice}") from None
        raise


def _is_whole(folder: Path) -> bool:
    try:
        _load_folder(folder)
    except InputError:
        return False
    return True


def _load_folder(path: Path) -> Checkpoint:
    if not (path / STATE).is_file():
        raise InputError(f"{path}: not a checkpoint (a run folder, a folder with {STATE}, or a .safetensors file)")
    try:
        state = json.loads(read_file(path / STATE, MAX_TEXT))
        hashes = dict(state["sha256"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path / STATE}: not a checkpoint's state, the checkpoint is broken") from None
    for name, expected in hashes.items():
        file = path / Path(name).name
        if not file.is_file() or sha256_of(file) != expected:
            raise InputError(f"{file}: missing, truncated or changed since it was written")
    if not {CONFIG, _WEIGHTS["model"]} <= set(hashes):
        raise InputError(f"{path}: the checkpoint holds no {CONFIG} or no {_WEIGHTS['model']}")
    config = _known_format(load_yaml(path / CONFIG), path / CONFIG)
    tensors = {name: _read_tensors(path / file) if file in hashes else {} for name, file in _WEIGHTS.items()}
    return Checkpoint(config=config, state=state, digest=digest_of(path), **tensors)


def export(checkpoint: Checkpoint, path: str | Path) -> None:
    """Writes the weights to predict with as one .safetensors file whose metadata holds config and state."""
    path = Path(path)
    if path.suffix != ".safetensors":
        raise InputError(f"{path}: a single-file checkpoint must end in .safetensors")
    metadata = {
        "gsim3d_config": json.dumps({"format": FORMAT, **checkpoint.config}),
        "gsim3d_state": json.dumps({"step": checkpoint.state.get("step", 0), "parent": checkpoint.digest}),
    }
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(_bytes_of(checkpoint.weights, metadata))
    os.replace(part, path)


def _bytes_of(tensors: dict[str, Tensor], metadata: dict[str, str] | None = None) -> bytes:
    """A .safetensors file. (Its own writer makes files that nobody else may read.)"""
    return safetensors.torch.save({k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}, metadata)


def _load_single(path: Path) -> Checkpoint:
    try:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
        config, state = json.loads(metadata["gsim3d_config"]), json.loads(metadata["gsim3d_state"])
    except (safetensors.SafetensorError, KeyError, ValueError):
        raise InputError(f"{path}: not a gsim3d checkpoint file") from None
    return Checkpoint(
        model=_read_tensors(path), config=_known_format(config, path), state=state, digest=sha256_of(path)
    )


def _known_format(config: dict, where: Path) -> dict:
    if config.get("format") != FORMAT:
        raise InputError(f"{where}: checkpoint format {config.get('format')!r}; this version reads {FORMAT}")
    missing = [name for name in ("model", "data") if not isinstance(config.get(name), dict)]
    if missing:
        raise InputError(f"{where}: the section {missing[0]} is missing")
    return {name: value for name, value in config.items() if name != "format"}


def _read_tensors(path: Path) -> dict[str, Tensor]:
    try:
        return load_file(path)
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None


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
    """``value`` with device and strides of ``weight``: few kernels update tensors that are alike, else one for each."""
    if value.stride() == weight.stride() and value.shape == weight.shape and value.device == weight.device:
        return value
    return torch.empty_like(weight, dtype=value.dtype, requires_grad=False).copy_(value)
