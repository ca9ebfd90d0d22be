"""Results on disk: a JSON file for each measurement, with those that it replaced."""

import dataclasses
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.evaluate.report import write_json
from gsim3d.evaluate.scoring import SceneScores
from gsim3d.io.files import read_file, with_parents
from gsim3d.io.plain import parse_json

MOST_BYTES = 2**26  # of a file


class Cells:
    """The results in OUT/cells, and in OUT/last those that they replaced."""

    def __init__(self, out: Path):
        self._now, self._last = out / "cells", out / "last"

    def read(self, name: Sequence[str], asked: dict) -> tuple[dict | None, dict | None]:
        """Returns (cell of ``name``, the parts of its path, measured as ``asked``: weights, scene, machine; the one
        before it). A cell of other terms is the one before."""
        cell, before = (_read(self._path(place, name)) for place in (self._now, self._last))
        if cell is None or cell["asked"] == asked:
            return cell, before
        os.replace(self._path(self._now, name), with_parents(self._path(self._last, name)))
        return None, cell

    def write(self, name: Sequence[str], cell: dict) -> None:
        """Writes a cell atomically."""
        write_json(with_parents(self._path(self._now, name)), cell)

    @staticmethod
    def _path(place: Path, name: Sequence[str]) -> Path:
        *folders, last = (re.sub(r"[^\w.-]+", "-", part) for part in name)
        return place.joinpath(*folders, f"{last}.json")


def _read(path: Path) -> dict | None:
    """Returns a cell; None if it is missing or damaged, so that it is measured again."""
    try:
        cell = parse_json(read_file(path, MOST_BYTES))
        return cell if {"asked", "result", "seconds", "device"} <= cell.keys() else None
    except (InputError, ValueError, AttributeError):
        return None


def to_json(scores: SceneScores, n_given: int) -> dict:
    """Converts scores to plain values; those of a shorter history are undefined at the first of ``n_given`` steps."""
    lacks = n_given - scores.n_encoded

    def padded(values: Tensor) -> Tensor:
        return torch.cat([values.new_full((lacks,), math.nan), values])

    return _plain(
        {
            **{f.name: getattr(scores, f.name) for f in dataclasses.fields(SceneScores)},
            "n_encoded": n_given,
            "n_steps": scores.n_steps + lacks,
            "values": {m: {k: padded(v) for k, v in found.items()} for m, found in scores.values.items()},
            "body_share": None if scores.body_share is None else padded(scores.body_share),
        }
    )


def from_json(content: dict, method: str = "model") -> SceneScores:
    """Converts the result of :func:`to_json` to scores that have ``method`` alone, as their model."""
    values = {metric: _tensor(v) for metric, v in content["values"][method].items()}
    physics, clips = (
        {kept: content[part][name] for kept, name in (("model", method), ("truth", "truth")) if name in content[part]}
        for part in ("physics", "clips")
    )
    return SceneScores(
        **{
            **content,
            "values": {"model": values},
            "clips": {name: _tensor(v).float() for name, v in clips.items()},
            "body_share": None if content["body_share"] is None else _tensor(content["body_share"]),
            "physics": {name: {m: _tensor(v) for m, v in found.items()} for name, found in physics.items()},
        }
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    if isinstance(value, Tensor):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _tensor(values: list) -> Tensor:
    return torch.from_numpy(np.array(values, np.float64))  # None becomes NaN
