"""Conversion of published weight files to state dicts of LPIPS and I3D, without executing their code."""

from __future__ import annotations

import io
import pickle

import numpy as np
import torch
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.io.pickles import check_pickle

BATCH_NORM_EPSILON = 1e-3  # of the original I3D

# The only names that a weights pickle may load: those of numpy arrays.
ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
}

_STEM = {"Conv3d_1a_7x7": "conv_1a", "Conv3d_2b_1x1": "conv_2b", "Conv3d_2c_3x3": "conv_2c"}
_BRANCHES = {
    "Branch_0/Conv3d_0a_1x1": "branch_0",
    "Branch_1/Conv3d_0a_1x1": "branch_1.0",
    "Branch_1/Conv3d_0b_3x3": "branch_1.1",
    "Branch_2/Conv3d_0a_1x1": "branch_2.0",
    "Branch_2/Conv3d_0b_3x3": "branch_2.1",
    "Branch_3/Conv3d_0b_1x1": "branch_3",
}
_LOGITS = "Logits/Conv3d_0c_1x1"


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str):
        if (module, name) not in ALLOWED:
            raise InputError(f"the pickle references {module}.{name}: only numpy arrays are allowed in weights")
        return ALLOWED[module, name]


def read_arrays(content: bytes) -> dict:
    """Reads nested dicts of numpy arrays from a pickle. Raises InputError if it contains anything else."""
    try:
        check_pickle(content)
        tree = _ArrayUnpickler(io.BytesIO(content)).load()
    except InputError:
        raise
    except Exception as error:  # a damaged pickle can raise any exception
        raise InputError(f"not a readable pickle: {str(error)[:200]}") from None
    _check_tree(tree)
    return tree


def _check_tree(tree) -> None:
    if isinstance(tree, dict) and all(isinstance(key, str) for key in tree):
        for value in tree.values():
            _check_tree(value)
    elif not (isinstance(tree, np.ndarray) and tree.dtype == np.float32):
        raise InputError(f"the pickle holds a {type(tree).__name__}: weights must be float32 arrays in dicts")


def lpips_tensors(tree: dict) -> dict[str, Tensor]:
    """Returns the state dict of :class:`gsim3d.evaluate.perceptual.lpips.LPIPS`."""
    (network,) = (name for name in tree if not name.startswith("NetLinLayer"))
    state = {}
    for i in range(len(tree[network])):
        conv = tree[network][f"Conv_{i}"]
        state[f"convs.{i}.weight"] = _tensor(conv["kernel"].transpose(3, 2, 0, 1))
        state[f"convs.{i}.bias"] = _tensor(conv["bias"])
    for i in range(len(tree) - 1):
        state[f"heads.{i}"] = _tensor(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1))
    return state


def i3d_tensors(tree: dict) -> dict[str, Tensor]:
    """Returns the state dict of :class:`gsim3d.evaluate.perceptual.i3d.I3D`; batch norms are folded in float64."""
    params, statistics = tree["params"], tree["batch_stats"]
    logits = params[_LOGITS]["Conv_0"]
    state = {
        "logits.weight": _tensor(logits["kernel"].transpose(4, 3, 0, 1, 2)),
        "logits.bias": _tensor(logits["bias"]),
    }
    for source, name in _STEM.items():
        _add_unit(state, f"{name}.conv", params[source], statistics[source])
    for block in params.keys() - _STEM.keys() - {_LOGITS}:
        for source, name in _BRANCHES.items():
            _add_unit(state, f"blocks.{block.lower()}.{name}.conv", params[block][source], statistics[block][source])
    return state


def _add_unit(state: dict[str, Tensor], name: str, params: dict, statistics: dict) -> None:
    mean, variance = (statistics["BatchNorm_0"][k].astype(np.float64).reshape(-1) for k in ("mean", "var"))
    gain = 1 / np.sqrt(variance + BATCH_NORM_EPSILON)
    kernel = params["Conv_0"]["kernel"].astype(np.float64).transpose(4, 3, 0, 1, 2)
    state[f"{name}.weight"] = _tensor(kernel * gain[:, None, None, None, None])
    state[f"{name}.bias"] = _tensor(params["BatchNorm_0"]["bias"] - mean * gain)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
