"""Trained simulators that come with gsim3d: a folder each, named like the model, whose name stands for its checkpoint.

A folder holds model.safetensors (bfloat16 weights with their configuration), config.yaml, training.jsonl (the log),
recipe.json (what it was trained on, and for how long), scores.json and README.md, the model card.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from gsim3d.errors import InputError, did_you_mean

FOLDER = Path(__file__).parent
WEIGHTS = "model.safetensors"
CHECKPOINT_HELP = "run folder, checkpoint folder, .safetensors file, or name of a simulator that comes with gsim3d"
KEEP = ("image", "depth")  # parts of a scene that need not be fitted to a model


def add_keep(parser: argparse.ArgumentParser) -> None:
    """Adds the option of commands that open one scene for a model."""
    parser.add_argument(
        "--keep",
        nargs="+",
        choices=KEEP,
        default=(),
        help="what of the scene is not fitted to the model: image: scaled, not cropped; depth: near and far",
    )


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
