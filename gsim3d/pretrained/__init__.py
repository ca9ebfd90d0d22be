"""Trained simulators shipped with gsim3d, one folder per model; a folder's name can be used as a checkpoint.

Files: model.safetensors (bfloat16 weights with configuration), config.yaml, training.jsonl (log), recipe.json (training
data and duration), scores.json, README.md (model card), laws.json if the model violates invariances of
docs/results/stability.md (the worst error of each), and trust.json if its errors are calibrated.
"""

import json
from pathlib import Path

from gsim3d.errors import InputError, did_you_mean

FOLDER = Path(__file__).parent
WEIGHTS, CONFIG, LAWS = "model.safetensors", "config.yaml", "laws.json"
CHECKPOINT_HELP = "run folder, checkpoint folder, .safetensors file, or name of a shipped simulator"
KEEP = ("image", "depth")  # parts of a scene that can be excluded from fitting to a model


def known_failures(checkpoint: str | Path) -> dict[str, dict]:
    """Returns check -> {"what", "error", "bound"}, the known failures of a shipped simulator; {} for others."""
    folder = Path(checkpoint).resolve().parent
    file = folder / LAWS
    return json.loads(file.read_text()) if folder.parent == FOLDER.resolve() and file.is_file() else {}


def names() -> list[str]:
    """Returns the names of the shipped simulators."""
    return sorted(file.parent.name for file in FOLDER.glob(f"*/{WEIGHTS}"))


def located(checkpoint: str | Path) -> Path:
    """Resolves a CHECKPOINT argument: an existing path, or else the weights of the shipped simulator of this name.

    Raises:
        InputError: neither exists; the message lists the names.
    """
    path = Path(checkpoint)
    if path.exists():
        return path / WEIGHTS if (path / WEIGHTS).is_file() and not (path / "state.json").exists() else path
    if str(checkpoint) in names():
        return FOLDER / str(checkpoint) / WEIGHTS
    known = f"shipped simulators: {', '.join(names()) or 'none'}"
    raise InputError(f"{checkpoint}: no such checkpoint ({known}{did_you_mean(checkpoint, names())})")


def folder_of(checkpoint: str | Path) -> Path:
    """Returns the folder of a checkpoint, or of its weight file. Raises InputError as :func:`located`."""
    path = located(checkpoint)
    return path if path.is_dir() else path.parent


def frame_rate(checkpoint: str | Path) -> float | None:
    """Returns the training frame rate of a shipped simulator from its config.yaml; None for others, or if absent.

    Needed because the metadata of older weight files do not contain it.
    """
    config = located(checkpoint).resolve().parent / CONFIG
    if not config.is_relative_to(FOLDER.resolve()) or not config.is_file():
        return None
    from gsim3d.io.files import read_yaml

    return read_yaml(config)["data"].get("fps")
