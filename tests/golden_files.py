"""Tensors of the published model: ``$GSIM3D_GOLDEN_DIR``, by default ``../shared/golden`` beside the repository."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

DEFAULT = Path(__file__).parents[1] / ".." / "shared" / "golden"


class Golden:
    """Arrays of one file under a key prefix: ``golden["features"]``; ``golden / "case"`` goes one level down."""

    def __init__(self, arrays, prefix: str = ""):
        self._arrays, self._prefix = arrays, prefix

    def __getitem__(self, key: str) -> Tensor:
        return torch.from_numpy(np.array(self._arrays[self._prefix + key]))

    def __contains__(self, key: str) -> bool:
        return self._prefix + key in self._arrays

    def __truediv__(self, name: str) -> "Golden":
        return Golden(self._arrays, f"{self._prefix}{name}/")

    def keys(self) -> list[str]:
        n = len(self._prefix)
        return [key[n:] for key in self._arrays.keys() if key.startswith(self._prefix)]


def golden_path(name: str) -> Path:
    """The path of a golden file; skips the test when it is absent."""
    path = Path(os.environ.get("GSIM3D_GOLDEN_DIR", DEFAULT)) / name
    if not path.exists():
        pytest.skip(f"golden file {path} is absent (set GSIM3D_GOLDEN_DIR)")
    return path


def golden(name: str) -> Golden:
    """The arrays of golden file ``<name>.npz``; skips the test when it is absent."""
    return Golden(np.load(golden_path(name + ".npz")))
