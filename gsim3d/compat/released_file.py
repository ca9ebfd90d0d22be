"""Safe reader of tensors in files of ``torch.save``, without executing code in them.

Such a file is a zip archive with a pickle ``data.pkl`` and storages ``data/0``, ``data/1``, ... A pickle can call any
function. This reader rebuilds tensors itself, replaces objects of known training packages by placeholders, and rejects
every other name.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.io.files import shown
from gsim3d.io.pickles import check_pickle

# Exceptions of zipfile for archives that are damaged, encrypted or larger than memory.
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, OSError, MemoryError, RuntimeError, ValueError)
MAX_INDEX = 256 * 2**20  # bytes of data.pkl; enough for a million tensors

_DTYPES = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32,
    "ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
# Objects of Lightning, its callbacks and OmegaConf next to the weights, which are replaced by placeholders.
_PLACEHOLDER_PACKAGES = {
    "pytorch_lightning", "lightning", "lightning_fabric", "lightning_utilities", "omegaconf", "numpy", "pathlib",
    "typing", "argparse", "datetime",
}  # fmt: skip
_PLACEHOLDERS = {
    "collections": "defaultdict Counter deque", "_codecs": "encode",
    "builtins": "set frozenset dict list tuple int long float complex str unicode bytes bytearray bool slice",
    "torch": "Size device Generator float32 float64 float16 bfloat16 int64 int32",
}  # fmt: skip


@dataclass(frozen=True)
class StoredTensor:
    """Reference to a tensor in the file: elements of storage ``key`` from ``offset``, with ``shape`` and ``stride``."""

    key: str
    dtype: torch.dtype
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def n_elements(self) -> int:
        return math.prod(self.shape)

    @property
    def end(self) -> int:
        """Index after the last element of the storage that the tensor uses."""
        last = sum((n - 1) * step for n, step in zip(self.shape, self.stride, strict=True))
        return self.offset + (last + 1 if self.n_elements else 0)


class Ignored:
    """Placeholder of an object that is not needed; accepts and discards all arguments."""

    def __call__(self, *args, **kwargs):
        return self

    def _ignore(self, *args, **kwargs):
        pass

    __init__ = __setitem__ = __setstate__ = append = extend = _ignore


class _Table(dict):
    """Dictionary that discards attributes; those of a state dict are version numbers of modules."""

    def __setstate__(self, state):
        pass


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, path: Path):
        super().__init__(io.BytesIO(data))
        self.path = path

    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}".replace("__builtin__.", "builtins.")  # torch.save writes Python 2's names
        if full in _KNOWN:
            return _KNOWN[full]
        module, _, name = full.rpartition(".")
        if name in _PLACEHOLDERS.get(module, "").split() or module.split(".")[0] in _PLACEHOLDER_PACKAGES:
            return Ignored
        said = f"it references {full}, which is not part of a checkpoint's weights and could run code"
        advice = "do not load this file with other programs either, unless you trust its source"
        raise InputError(f"{self.path}: rejected: {said}; {advice}")

    def persistent_load(self, pid: Any) -> tuple[str, torch.dtype]:
        match pid:
            case ("storage", torch.dtype() as dtype, str() as key, str(), int()):
                return key, dtype
        raise InputError(f"{self.path}: unknown description of a tensor's storage: {shown(pid)}")


def _stored_tensor(storage, offset, shape, stride, *_) -> StoredTensor:
    key, dtype = storage
    values = (offset, *shape, *stride)
    if len(shape) != len(stride) or not all(type(n) is int and 0 <= n < 2**48 for n in values):
        raise ValueError("a tensor's size or stride is out of range")
    return StoredTensor(key, dtype, offset, tuple(shape), tuple(stride))


_KNOWN = {
    "collections.OrderedDict": _Table,
    "torch._utils._rebuild_tensor_v2": _stored_tensor,
    "torch._utils._rebuild_parameter": lambda data, *_: data,
    **{f"torch.{name}": dtype for name, dtype in _DTYPES.items()},
}


class ReleasedFile:
    """An open file of ``torch.save``.

    Attributes:
        path: path of the file.
        content: the stored object; its tensors are :class:`StoredTensor`, see :meth:`read`.

    Raises:
        InputError: the file is of another kind, damaged, or could run code; the message names it.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such file")
        try:
            self._zip = zipfile.ZipFile(self.path)
        except BROKEN:
            raise InputError(
                f"{self.path}: not a checkpoint that torch.save wrote as a zip archive (it is truncated, another kind "
                "of file, or older than torch 1.6; the last can be saved again with a newer torch)"
            ) from None
        try:
            self._root, self._members = self._index()
            self.content = self._unpickle()
        except InputError:
            self._zip.close()
            raise

    def __enter__(self) -> ReleasedFile:
        return self

    def __exit__(self, *_) -> None:
        self._zip.close()

    def read(self, stored: StoredTensor) -> Tensor:
        """Reads a tensor; floating-point values are converted to float32."""
        member = self._members.get(f"{self._root}data/{stored.key}")
        item = stored.dtype.itemsize
        available = member.file_size // item if member else 0
        if member is None or stored.end > available or stored.n_elements > available:
            raise InputError(f"{self.path}: damaged: a tensor of shape {list(stored.shape)} exceeds its storage")
        if stored.n_elements == 0:
            values = torch.zeros(stored.shape, dtype=stored.dtype)
        else:
            flat = torch.frombuffer(bytearray(self._bytes_of(member)), dtype=stored.dtype)
            values = flat.as_strided(stored.shape, stored.stride, stored.offset)
        return values.to(torch.float32 if stored.dtype.is_floating_point else stored.dtype).clone()

    def _bytes_of(self, member: zipfile.ZipInfo) -> bytes:
        try:
            return self._zip.read(member)
        except BROKEN as error:
            raise InputError(f"{self.path}: truncated or changed: {error or 'out of memory'}") from None

    def _index(self) -> tuple[str, dict[str, zipfile.ZipInfo]]:
        """Returns the root folder in the archive, and its members by name."""
        members = {info.filename: info for info in self._zip.infolist()}
        roots = [name.removesuffix("data.pkl") for name in members if name.split("/")[1:] == ["data.pkl"]]
        if len(roots) != 1:
            raise InputError(f"{self.path}: a zip archive, but not of torch.save: it has no data.pkl")
        for info in members.values():
            # Uncompressed members cannot be larger than the file, which excludes zip bombs.
            if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
                raise InputError(f"{self.path}: rejected: {info.filename} is compressed, which torch.save never does")
        order = members.get(f"{roots[0]}byteorder")
        if order is not None and self._bytes_of(order) != b"little":
            raise InputError(f"{self.path}: written on a big-endian machine, which is not supported")
        return roots[0], members

    def _unpickle(self) -> Any:
        info = self._members[f"{self._root}data.pkl"]
        if info.file_size > MAX_INDEX:
            raise InputError(f"{self.path}: data.pkl has {info.file_size} bytes; at most {MAX_INDEX} are allowed")
        try:
            data = self._bytes_of(info)
            check_pickle(data)
            return _Unpickler(data, self.path).load()
        except InputError:
            raise
        except Exception as error:  # a damaged pickle can raise any exception
            raise InputError(f"{self.path}: data.pkl is damaged: {str(error)[:200]}") from None


def state_dict(file: ReleasedFile) -> tuple[dict[str, StoredTensor], dict[str, int]]:
    """Returns the weights of a Lightning checkpoint or of a plain state dict, and its epoch and step if stored."""
    content = file.content
    if not isinstance(content, dict):
        raise InputError(f"{file.path}: contains a {type(content).__name__}, not a checkpoint")
    weights = content.get("state_dict", content)
    if not isinstance(weights, dict) or not all(isinstance(name, str) for name in weights):
        raise InputError(f"{file.path}: its state_dict is not a dictionary of named tensors")
    tensors = {name: value for name, value in weights.items() if isinstance(value, StoredTensor)}
    if not tensors:
        known = ", ".join(str(name)[:80] if isinstance(name, str) else shown(name) for name in list(content)[:8])
        raise InputError(f"{file.path}: contains no weights: neither state_dict nor tensors, but {known or 'nothing'}")
    counts = {name: content[name] for name in ("epoch", "global_step") if type(content.get(name)) is int}
    return tensors, counts
