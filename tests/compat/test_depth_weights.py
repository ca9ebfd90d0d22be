"""Published weights by name: every listed key arrives, others are refused by name."""

import functools
import re

import pytest
import torch
from safetensors.torch import save_file

from gsim3d.compat.depth_weights import load_depth_weights
from gsim3d.errors import InputError
from gsim3d.nn.multiview_encoder import Encoder, EncoderConfig
from gsim3d.nn.multiview_encoder.config import ViTConfig
from tests.nn.multiview_encoder.published_keys import keys_of, state_dict_of

STARTS = {"model.backbone.pretrained.": "backbone.", "model.head.": "depth_head.", "model.cam_enc.": "camera_encoder."}


@functools.cache
def encoder_of(model: str) -> Encoder:
    return Encoder(EncoderConfig(backbone="vit_dpt", vit=ViTConfig(model)))


def load(tensors: dict, model: str, tmp_path) -> list[str]:
    save_file(tensors, tmp_path / "weights.safetensors")
    return load_depth_weights(encoder_of(model), tmp_path / "weights.safetensors")


@pytest.mark.parametrize("size", ["small", "base"])
def test_every_key_of_depth_anything(size, tmp_path):
    keys = [key for key in keys_of(f"depth_anything_{size}") if key.use != "tied"]
    tensors = state_dict_of(keys, torch.bfloat16)
    skipped = load(tensors, f"depth_anything_{size}", tmp_path)
    assert sorted(skipped) == sorted(key.name for key in keys if key.use == "skip") and len(skipped) == 104
    own, used = encoder_of(f"depth_anything_{size}").depth.state_dict(), set()
    for key in keys:
        if key.use != "skip":
            start = next(start for start in STARTS if key.name.startswith(start))
            name = STARTS[start] + key.name.removeprefix(start)
            assert torch.equal(own[name], tensors[key.name].float()), key.name
            used.add(name)
    assert {name for name in own if name.startswith(tuple(STARTS.values()))} == used
    assert len(used) == 207 + 62 + 64


def test_tied_tensors_may_be_there(tmp_path):
    keys = keys_of("depth_anything_small")
    skipped = load(state_dict_of(keys), "depth_anything_small", tmp_path)
    assert {key.name for key in keys if key.use == "tied"} < set(skipped)


@pytest.mark.parametrize("file", ["dinov2_small_hf", "dinov2_small_transformers5", "dinov2_small_timm"])
def test_every_key_of_dinov2(file, tmp_path):
    keys = keys_of(file)
    tensors = state_dict_of(keys, torch.float16)
    untouched = encoder_of("dinov2_small").depth.depth_head.projects[0].weight.clone()
    skipped = load(tensors, "dinov2_small", tmp_path)
    assert skipped == [key.name for key in keys if key.use == "skip"]
    depth = encoder_of("dinov2_small").depth
    own, left = depth.backbone.state_dict(), set(depth.backbone.state_dict())
    for key in keys:
        if key.use == "yes":
            name, rows = re.fullmatch(r"(.+?)(?:\[(\d+:\d+)\])?", key.own or key.name).groups()
            value = own[name] if rows is None else own[name][slice(*map(int, rows.split(":")))]
            assert torch.equal(value, tensors[key.name].float()), key.name
            left.discard(name)
    assert not left
    assert torch.equal(depth.depth_head.projects[0].weight, untouched)


def changed(file: str, old: str, new: str | None = None, value=None) -> dict:
    tensors = state_dict_of(keys_of(file))
    found = tensors.pop(old)
    if new is not None:
        tensors[new] = found if value is None else value
    return tensors


ANY, HF = "depth_anything_small", "dinov2_small_hf"
Q = "encoder.layer.3.attention.attention.query.weight"
NORM = "model.head.norm.weight"


@pytest.mark.parametrize(
    "file, model, change, message",
    [
        (
            ANY,
            ANY,
            (NORM, "model.head.normal.weight"),
            r"model\.head\.normal\.weight is no weight of depth_any",
        ),
        (ANY, ANY, (NORM,), r"lacks 1 tensors that depth_anything_small needs, first depth_head\.norm\.weight$"),
        (ANY, ANY, (NORM, NORM, torch.zeros(3)), r"model\.head\.norm\.weight is \[3\], but \[768\]"),
        (ANY, ANY, (NORM, NORM, torch.full((768,), torch.nan)), r"model\.head\.norm\.weight is not of finite"),
        (ANY, ANY, (NORM, NORM, torch.zeros(768, dtype=torch.int32)), r"model\.head\.norm\.weight is not of finite"),
        (ANY, "dinov2_small", (NORM, NORM), r"model\.\S* is no weight of dinov2_small"),
        (ANY, ANY, (NORM, "model.cam_decoder.x"), r"model\.cam_decoder\.x is no weight"),
        (
            HF,
            "dinov2_small",
            (Q, Q.replace("query", "quer")),
            r"query, key, value; there is no \S*blocks\.3\.attn\.q",
        ),
        (HF, "dinov2_small", (Q,), r"encoder\.layer\.3\.\S* needs query, key, value; there is no \S*3\.attn\.query"),
        (HF, "dinov2_base", (Q, Q), r"embeddings\.\S* is \[\S+, \S+, 384\], but .*set encoder.vit.model to its size"),
        (HF, ANY, (Q, Q), r"lacks 33 tensors that depth_anything_small needs, first backbone\.\S*"),
    ],
)
def test_other_keys_are_refused_by_name(file, model, change, message, tmp_path):
    before = {name: value.clone() for name, value in encoder_of(model).depth.state_dict().items()}
    with pytest.raises(InputError, match=r"weights\.safetensors: " + f".*{message}"):
        load(changed(file, *change), model, tmp_path)
    assert all(torch.equal(value, before[name]) for name, value in encoder_of(model).depth.state_dict().items())


def test_unreadable_files(tmp_path):
    for content in (b"", b"PK\x03\x04 a pickle"):
        (tmp_path / "a.safetensors").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.safetensors: not a readable \.safetensors file"):
            load_depth_weights(encoder_of("dinov2_small"), tmp_path / "a.safetensors")
    with pytest.raises(InputError, match=r"b\.safetensors: no such file"):
        load_depth_weights(encoder_of("dinov2_small"), tmp_path / "b.safetensors")
    with pytest.raises(InputError, match="needs an encoder with backbone vit_dpt; this one has plane_sweep"):
        load_depth_weights(Encoder(EncoderConfig.tiny()), tmp_path / "a.safetensors")
