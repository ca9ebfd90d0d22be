"""Reading files of torch.save without running what is in them."""

import collections
import os
import pickle
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from gsim3d.compat.released_file import ReleasedFile, StoredTensor, state_dict
from gsim3d.errors import InputError


def write(path, content):
    torch.save(content, path)
    return path


def test_every_kind_of_tensor_is_read_as_it_was(tmp_path):
    generator = torch.Generator().manual_seed(0)
    base = torch.randn(6, 5, generator=generator)
    tensors = collections.OrderedDict(
        plain=base,
        transposed=base.T,
        part=base[1:4, 2:],
        scalar=torch.tensor(7),
        empty=torch.zeros(0, 3),
        half=torch.randn(4, generator=generator).half(),
        bfloat=torch.randn(4, generator=generator).bfloat16(),
        double=torch.randn(4, generator=generator).double(),
        parameter=torch.nn.Parameter(torch.randn(3, generator=generator)),
    )
    with ReleasedFile(write(tmp_path / "a.ckpt", {"state_dict": tensors, "epoch": 2, "global_step": 9})) as file:
        stored, counts = state_dict(file)
        assert counts == {"epoch": 2, "global_step": 9} and list(stored) == list(tensors)
        for name, value in tensors.items():
            expected = value.detach().float() if value.is_floating_point() else value
            assert torch.equal(file.read(stored[name]), expected), name
            assert stored[name].shape == tuple(value.shape)


def test_bare_state_dict_is_a_checkpoint_too(tmp_path):
    path = write(tmp_path / "a.ckpt", torch.nn.Linear(2, 3).state_dict())
    with ReleasedFile(path) as file:
        stored, counts = state_dict(file)
    assert {name: tensor.shape for name, tensor in stored.items()} == {"weight": (3, 2), "bias": (3,)} and not counts


def test_objects_of_training_tools_are_ignored(tmp_path, monkeypatch):
    module = types.ModuleType("omegaconf.dictconfig")
    module.DictConfig = type("DictConfig", (), {"__module__": "omegaconf.dictconfig"})
    monkeypatch.setitem(sys.modules, "omegaconf", types.ModuleType("omegaconf"))
    monkeypatch.setitem(sys.modules, "omegaconf.dictconfig", module)
    config = module.DictConfig()
    config.content = {"a": 1}
    extra = {
        "hyper_parameters": config, "dirpath": Path("/some/where"), "score": np.float64(3.5), "array": np.arange(3.0),
        "seen": {1, 2}, "kinds": [int, str, float, bytes, dict, list],
        "table": collections.defaultdict(list, a=[1]), "device": torch.device("cpu"),
    }  # fmt: skip
    path = write(tmp_path / "a.ckpt", {"state_dict": {"w": torch.ones(2)}, **extra})
    monkeypatch.delitem(sys.modules, "omegaconf.dictconfig")
    monkeypatch.delitem(sys.modules, "omegaconf")
    with ReleasedFile(path) as file:
        assert state_dict(file)[0].keys() == {"w"}
        assert "omegaconf" not in sys.modules


class Calls:
    """Its pickle calls a function when it is loaded."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("place", ["state_dict", "callbacks", "top"])
@pytest.mark.parametrize(
    ("function", "name"),
    [(os.system, "system"), (exec, "builtins.exec"), (eval, "builtins.eval"), (getattr, "builtins.getattr"),
     (torch.load, "torch.serialization.load"), (pickle.loads, "loads"), (open, "open")],
)  # fmt: skip
def test_file_that_could_run_code_is_refused(tmp_path, function, name, place):
    evil = Calls(function, f"open({str(tmp_path / 'run')!r}, 'w')")
    content = {
        "state_dict": {"state_dict": {"w": torch.ones(2), "x": evil}},
        "callbacks": {"state_dict": {"w": torch.ones(2)}, "callbacks": {"a": [evil]}},
        "top": evil,
    }[place]
    path = write(tmp_path / "evil.ckpt", content)
    with pytest.raises(InputError, match=f"evil.ckpt: rejected: it references .*{name}.*could run code"):
        ReleasedFile(path)
    assert not (tmp_path / "run").exists()


def rewrite(path, change, compression=zipfile.ZIP_STORED):
    """The same archive with members changed: ``change(name, bytes)`` -> bytes, or None to leave it out."""
    with zipfile.ZipFile(path) as archive:
        members = {name: change(name, archive.read(name)) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            if data is not None:
                archive.writestr(name, data)
    return path


def example(tmp_path):
    return write(tmp_path / "a.ckpt", {"state_dict": {"w": torch.arange(12.0).reshape(3, 4)}})


def test_broken_files_are_named(tmp_path):
    with pytest.raises(InputError, match="b.ckpt: no such file"):
        ReleasedFile(tmp_path / "b.ckpt")
    path = example(tmp_path)
    content = path.read_bytes()
    for broken in (content[: len(content) // 2], b"", b"text"):
        path.write_bytes(broken)
        with pytest.raises(InputError, match="a.ckpt: not a checkpoint"):
            ReleasedFile(path)
    with pytest.raises(InputError, match="no data.pkl"):
        ReleasedFile(rewrite(example(tmp_path), lambda name, data: None if name.endswith("data.pkl") else data))
    with pytest.raises(InputError, match="compressed"):
        ReleasedFile(rewrite(example(tmp_path), lambda name, data: data, zipfile.ZIP_DEFLATED))
    with pytest.raises(InputError, match="data.pkl is damaged"):
        ReleasedFile(rewrite(example(tmp_path), lambda name, data: data[:-9] if name.endswith("data.pkl") else data))
    with pytest.raises(InputError, match="big-endian"):
        ReleasedFile(rewrite(example(tmp_path), lambda name, data: b"big" if name.endswith("byteorder") else data))


def test_flipped_bit_of_the_numbers_is_found(tmp_path):
    path = example(tmp_path)
    content = bytearray(path.read_bytes())
    content[content.find(np.arange(12.0, dtype=np.float32).tobytes()) + 5] ^= 1
    path.write_bytes(content)
    with ReleasedFile(path) as file, pytest.raises(InputError, match="truncated or changed"):
        file.read(state_dict(file)[0]["w"])


def test_tensor_larger_than_its_storage_is_refused(tmp_path):
    path = rewrite(example(tmp_path), lambda name, data: data[:-4] if name.endswith("data/0") else data)
    with ReleasedFile(path) as file:
        stored = state_dict(file)[0]["w"]
        with pytest.raises(InputError, match="exceeds its storage"):
            file.read(stored)
        for shape, stride in (((10**6,), (0,)), ((3, 3), (4, 2)), ((2, 2), (10, 1))):
            with pytest.raises(InputError, match="exceeds its storage"):
                file.read(StoredTensor(stored.key, stored.dtype, 0, shape, stride))
        with pytest.raises(InputError, match="exceeds its storage"):
            file.read(StoredTensor("7", stored.dtype, 0, (1,), (1,)))


def test_index_that_would_fill_the_memory_is_refused(tmp_path):
    huge = pickle.PROTO + b"\x02" + pickle.EMPTY_DICT + pickle.LONG_BINPUT + b"\xff\xff\xff\x7f" + pickle.STOP
    path = rewrite(example(tmp_path), lambda name, data: huge if name.endswith("data.pkl") else data)
    with pytest.raises(InputError, match="memo is out of range"):
        ReleasedFile(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [([1, 2], "contains a list"), ({"a": 1}, "contains no weights"), ({"state_dict": 3}, "not a dictionary"),
     ({"state_dict": {1: torch.ones(1)}}, "not a dictionary")],
)  # fmt: skip
def test_file_without_weights_is_refused(tmp_path, content, message):
    with ReleasedFile(write(tmp_path / "a.ckpt", content)) as file, pytest.raises(InputError, match=message):
        state_dict(file)
