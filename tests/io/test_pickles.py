"""Pickles of a few hundred bytes that would print or hash for ever are refused before they are read."""

import pickle
import zipfile

import pytest
import torch

from gsim3d.compat.released_file import ReleasedFile
from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.convert import read_arrays
from gsim3d.io import pickles

LEAVES = b"K\x01" + b"q\x00h\x00\x86" * 40  # a tuple of two of a tuple of two ... of 1
COPIES = b"K\x01" + b"2\x86" * 40  # the same with DUP
MEMOIZED = b"\x80\x04K\x01" + b"".join(b"\x94h" + bytes([i]) + b"\x86" for i in range(40))
DEEP = b"K\x01" + b"\x85" * 200_000
THREE = b"K\x01" + b"q\x00h\x00h\x00\x87" * 30
MARKED = b"K\x01" + b"".join(b"q\x00(h\x00h\x00t" for _ in range(40))
BOMBS = {"leaves": LEAVES, "copies": COPIES, "memoized": MEMOIZED, "deep": DEEP, "three": THREE, "marked": MARKED}
USES = {
    "persistent id": lambda bomb: bomb + b"Q.",
    "key": lambda bomb: b"}" + bomb + b"K\x02s.",
    "one of many keys": lambda bomb: b"}(" + bomb + b"K\x02u.",
    "key of a key's table": lambda bomb: b"}K\x01}" + bomb + b"Nss.",
    "content": lambda bomb: bomb + b".",
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("bomb", BOMBS)
def test_check_pickle_refuses_nested_tuples(tmp_path, bomb, use):
    data = USES[use](BOMBS[bomb])
    with zipfile.ZipFile(tmp_path / "m.ckpt", "w") as archive:
        archive.writestr("archive/data.pkl", data)
    for read in (lambda: ReleasedFile(tmp_path / "m.ckpt"), lambda: read_arrays(data)):
        with pytest.raises(InputError, match="a tuple of more than") as error:
            read()
        assert len(str(error.value)) < 200 + len(str(tmp_path))


def test_check_pickle_refuses_long_pickles_and_far_indices(monkeypatch):
    with pytest.raises(ValueError, match="index of its memo"):
        pickles.check_pickle(b"K\x01r\xff\xff\xff\x7f.")
    monkeypatch.setattr(pickles, "MAX_OPS", 1000)
    with pytest.raises(ValueError, match="more than 1000 instructions"):
        pickles.check_pickle(b"N0" * 1000 + b"N.")


@pytest.mark.parametrize("protocol", range(6))
def test_check_pickle_passes_harmless_values(protocol):
    shared = (1, 2)
    table = {"c": (torch.Size([3]), frozenset({1}), b"x", None, 1.5)}
    content = {"a": [shared] * 1000, ("b", shared): table, 3: [[[]]]}
    pickles.check_pickle(pickle.dumps(content, protocol))
