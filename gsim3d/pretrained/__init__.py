"""Trained simulators that come with gsim3d: a folder each, named like the model, whose name stands for its checkpoint.

A folder holds model.safetensors (bfloat16 weights with their configuration), config.yaml, training.jsonl (the log),
recipe.json (what it was trained on, and for how long), scores.json, README.md, the model card, and laws.json where
the model breaks laws of docs/results/stability.md: the worst number of each, as the card has it.
"""

from __future__ import annotations

import json
from pathlib import Path

from gsim3d.errors import InputError, did_you_mean

FOLDER = Path(__file__).parent
WEIGHTS, CONFIG, LAWS = "model.safetensors", "config.yaml", "laws.json"
CHECKPOINT_HELP = "run folder, checkpoint folder, .safetensors file, or name of a simulator that comes with gsim3d"
KEEP = ("image", "depth")  # parts of a scene that need not be fitted to a model


def known_failures(checkpoint: str | Path) -> dict[str, dict]:
    """Check -> {"what", "error", "bound"}: what a simulator that comes with gsim3d is known to break; {} of others."""
    folder = Path(checkpoint).resolve().parent
    file = folder / LAWS
    return json.loads(file.read_text()) if folder.parent == FOLDER.resolve() and file.is_file() else {}


def names() -> list[str]:
    """Those that are here."""
    return sorted(file.parent.name for file in FOLDER.glob(f"*/{WEIGHTS}"))


def located(checkpoint: str | Path) -> Path:
    """What a CHECKPOINT argument means: a path that exists, or else the weights of the simulator of this name.

    Raises:
        InputError: neither; the message lists the names.
    """
    path = Path(checkpoint)
    if path.exists():
        return path
    if str(checkpoint) in names():
        return FOLDER / str(checkpoint) / WEIGHTS
    known = f"simulators that come with gsim3d: {', '.join(names())}" if names() else "none comes with gsim3d"
    raise InputError(f"{checkpoint}: no such checkpoint ({known}{did_you_mean(checkpoint, names())})")


def folder_of(checkpoint: str | Path) -> Path:
    """The folder in or beside which the weights of a checkpoint are. Raises InputError as :func:`located`."""
    path = located(checkpoint)
    return path if path.is_dir() else path.parent


def frame_rate(checkpoint: str | Path) -> float | None:
    """Frames per second of the training of a simulator that comes with gsim3d; None: of others, or not stated.

    Its config.yaml says so where the metadata of its weights, which are older, do not.
    """
    config = located(checkpoint).resolve().parent / CONFIG
    if not config.is_relative_to(FOLDER.resolve()) or not config.is_file():
        return None
    from gsim3d.io.files import read_yaml

    return read_yaml(config)["data"].get("fps")
