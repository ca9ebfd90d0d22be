"""Tensors of the published model.

They are read from ``$GSIM3D_GOLDEN_DIR``; where it is not set, from ``../shared/golden`` beside the repository, and
where that is absent, from the small set in ``tests/golden/data``. A test whose file is not there is skipped.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

BESIDE = Path(__file__).parents[1] / ".." / "shared" / "golden"
COMMITTED = Path(__file__).parent / "golden" / "data"

READ: set[tuple[str, str]] = set()  # (file, array) of all that tests of this process have read


class Golden:
    """Arrays of one file under a key prefix: ``golden["features"]``; ``golden / "case"`` goes one level down."""

    def __init__(self, name: str, arrays, prefix: str = ""):
        self.name, self._arrays, self._prefix = name, arrays, prefix

    def __getitem__(self, key: str) -> Tensor:
        READ.add((self.name, self._prefix + key))
        return torch.from_numpy(np.array(self._arrays[self._prefix + key]))

    def text(self, key: str) -> str:
        READ.add((self.name, self._prefix + key))
        return str(self._arrays[self._prefix + key])

    def __contains__(self, key: str) -> bool:
        return self._prefix + key in self._arrays

    def __truediv__(self, name: str) -> "Golden":
        return Golden(self.name, self._arrays, f"{self._prefix}{name}/")

    def keys(self) -> list[str]:
        n = len(self._prefix)
        return [key[n:] for key in self._arrays.keys() if key.startswith(self._prefix)]

    def dict(self) -> dict[str, Tensor]:
        return {key: self[key] for key in self.keys()}


def golden_directory() -> Path:
    if "GSIM3D_GOLDEN_DIR" in os.environ:
        return Path(os.environ["GSIM3D_GOLDEN_DIR"])
    return BESIDE if BESIDE.exists() else COMMITTED


def golden_path(name: str) -> Path:
    """The path of a golden file; skips the test when it is absent."""
    path = golden_directory() / name
    if not path.exists():
        path = golden_directory().parent / "specs" / "golden" / name  # of other published models
    if not path.exists():
        pytest.skip(f"golden file {path} is absent (set GSIM3D_GOLDEN_DIR)")
    return path


def golden(name: str) -> Golden:
    """The arrays of golden file ``<name>.npz``; skips the test when it is absent."""
    return Golden(name, np.load(golden_path(name + ".npz")))


def published_config(name: str) -> dict:
    """The resolved configuration ``name`` ("small", "small_deep_dynamics") of the golden files' models."""
    return json.loads(golden_path("params_full.json").read_text())[name]["resolved_config"]
