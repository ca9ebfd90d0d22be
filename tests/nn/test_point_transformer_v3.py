"""Against tensors of the authors' code with random weights, which the file beside this one holds as bfloat16."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gsim3d import InputError
from gsim3d.nn import PointTransformerV3, PointTransformerV3Config
from gsim3d.ops import build_pyramid

TOLERANCE = 1e-5  # of the largest value; float32 noise is 1e-6
ARRAYS = np.load(Path(__file__).with_name("point_transformer_v3.npz"))


def array(key: str) -> Tensor:
    return torch.from_numpy(np.array(ARRAYS[key]))


def weights() -> dict[str, Tensor]:
    keys = [key for key in ARRAYS.files if key.startswith("w/")]
    return {key[2:]: array(key).view(torch.bfloat16).float() for key in keys}


def config(**changes) -> PointTransformerV3Config:
    said = json.loads(str(ARRAYS["config"]))
    own = PointTransformerV3Config(
        in_channels=said["in_channels"],
        curves=tuple(said["order"]),
        strides=tuple(said["stride"]),
        patch_sizes=tuple(said["enc_patch_size"]),
        encoder_depths=tuple(said["enc_depths"]),
        encoder_channels=tuple(said["enc_channels"]),
        encoder_heads=tuple(said["enc_num_head"]),
        decoder_depths=tuple(said["dec_depths"]),
        decoder_channels=tuple(said["dec_channels"]),
        decoder_heads=tuple(said["dec_num_head"]),
    )
    return dataclasses.replace(own, **changes)


def loaded(**changes) -> PointTransformerV3:
    model = PointTransformerV3(config(**changes)).eval()
    assert model.load_pointcept(weights()) == []
    return model


def cells_of(case: str) -> tuple[Tensor, Tensor]:
    if case == "main":
        positions = array("main/in/coord")
        cells = torch.trunc((positions - positions.amin(0)) / array("main/in/grid_size")).int()
    else:
        cells = array(f"{case}/in/grid_coord")
    if case == "grid":
        return cells, torch.cat([torch.zeros(1, dtype=torch.int64), array("grid/in/batch").bincount().cumsum(0)])
    return cells, torch.cat([torch.zeros(1, dtype=torch.int64), array(f"{case}/in/offset")])


@pytest.mark.parametrize(
    ("case", "key", "changes"),
    [
        ("main", "final", {}),
        ("main", "final_v151", {"mirror": "mlp"}),
        ("main", "final_shuffled", {}),
        ("grid", "final", {}),
        ("grid", "final_depth_plus", {"depth_rule": "count"}),
        ("dup", "final", {}),
    ],
)
@torch.no_grad()
def test_output_repeats_the_published_network(case, key, changes):
    model, (cells, cu_rows) = loaded(**changes), cells_of(case)
    permutations = array("main/shuffle/perms").tolist() if key == "final_shuffled" else None
    pyramid = model.pyramid(cells, cu_rows, permutations=permutations)
    expected = array(f"{case}/out/{key}")
    error = (model(array(f"{case}/in/feat"), pyramid) - expected).abs().max() / expected.abs().max()
    assert error < TOLERANCE


@torch.no_grad()
def test_output_in_float64():
    model, expected = loaded().double(), array("main/f64/final")
    out = model(array("main/in/feat").double(), model.pyramid(*cells_of("main")))
    assert (out - expected).abs().max() / expected.abs().max() < 1e-12


@pytest.mark.parametrize("mirror", ["block", "mlp"])
def test_every_weight_has_a_gradient_in_training(mirror):
    model = loaded(mirror=mirror).train()
    out = model(array("dup/in/feat"), model.pyramid(*cells_of("dup")), generator=torch.Generator().manual_seed(0))
    out.square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def test_published_checkpoints_load_with_prefixes_and_name_their_heads():
    state = {f"module.backbone.{key}": value for key, value in weights().items()}
    state |= {"module.seg_head.weight": torch.zeros(1), "module.backbone.embedding.stem.norm.num_batches_tracked": 0}
    assert PointTransformerV3(config()).load_pointcept(state) == ["seg_head.weight"]


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("enc.enc0.block0.attn.rpe.rpe_table", "RPE"),
        ("embedding.stem.norm.norm.0.weight", "PDNorm"),
        ("enc.enc1.down.norm.0.norm.1.weight", "PDNorm"),
        ("embedding.stem.linear.weight", "Sonata"),
        ("enc.enc0.block0.attn.rope.inv_freq", "Utonia"),
        ("embedding_table.weight", "Point Prompt Training"),
        ("enc.enc0.block0.attn.qkv.lora_A.default.weight", "LoRA"),
        ("enc.enc1.merger.pos_emb", "3DGSim"),
        ("enc.enc9.block0.norm1.0.weight", "unknown: enc.enc9"),
    ],
)
def test_keys_of_other_networks_are_refused_by_name(key, message):
    with pytest.raises(InputError, match=message):
        PointTransformerV3(config()).load_pointcept(weights() | {key: torch.zeros(1)})


def test_missing_and_misshapen_keys_are_named():
    state = weights()
    del state["dec.dec0.block0.mlp.0.fc1.bias"]
    with pytest.raises(InputError, match=r"missing: dec\.dec0\.block0\.mlp\.0\.fc1\.bias"):
        PointTransformerV3(config()).load_pointcept(state)
    state = weights() | {"embedding.stem.conv.weight": torch.zeros(5, 5, 5, 6, 16)}
    with pytest.raises(InputError, match=r"embedding\.stem\.conv\.weight must be \[16, 5, 5, 5, 6\]"):
        PointTransformerV3(config()).load_pointcept(state)


@pytest.mark.parametrize("curves", [("z",), ("hilbert", "z", "z-trans")])
@torch.no_grad()
def test_any_number_of_curves(curves):
    model = loaded(curves=curves)
    pyramid = model.pyramid(*cells_of("dup"))
    assert all(len(stage.patches) == len(curves) for stage in pyramid.stages)
    assert model(array("dup/in/feat"), pyramid).isfinite().all()


@torch.no_grad()
def test_points_in_one_cell_and_empty_clouds():
    model, features = loaded(), torch.ones(3, 6)
    out = model(features, model.pyramid(torch.zeros(3, 3, dtype=torch.int64), torch.tensor([0, 0, 3, 3])))
    assert out.shape == (3, 32) and out.isfinite().all()
    empty = model.pyramid(torch.zeros(0, 3, dtype=torch.int64), torch.tensor([0, 0]))
    assert model(features[:0], empty).shape == (0, 32)


def test_arguments_are_checked():
    model, cu_rows = PointTransformerV3(config()), torch.tensor([0, 1])
    with pytest.raises(InputError, match="cells must be in"):
        model.pyramid(torch.full((1, 3), -1), cu_rows)
    with pytest.raises(InputError, match="cells must be in"):
        model.pyramid(torch.full((1, 3), 1 << 16), cu_rows)
    with pytest.raises(InputError, match=r"cells must be in \[0, 2\^2\); got 3 \.\. 4"):
        model.pyramid(torch.tensor([[3, 4, 3]]), cu_rows, depth=2)
    largest = torch.full((1, 3), (1 << 16) - 1)
    assert PointTransformerV3(config(depth_rule="count")).pyramid(largest, cu_rows).rows.tolist() == [0]
    with pytest.raises(InputError, match="cells must be int32 or int64"):
        model.pyramid(torch.zeros(1, 3), cu_rows)
    with pytest.raises(TypeError, match="PointTransformerV3: cells must be a tensor; got ndarray"):
        model.pyramid(np.zeros((1, 3), int), cu_rows)
    with pytest.raises(InputError, match=r"pyramid must have 3 levels; got 0; use \.pyramid\(\)"):
        model(torch.zeros(1, 6), torch.zeros(1, 3))
    assert config(encoder_channels=[16, 32, 64]).encoder_channels == [16, 32, 64]
    with pytest.raises(InputError, match="permutations must be 3 orders of 4"):
        model.pyramid(torch.zeros(1, 3, dtype=torch.int64), cu_rows, permutations=[[0, 1, 2, 3]])
    with pytest.raises(InputError, match="x must be"):
        model(torch.zeros(2, 6), model.pyramid(torch.zeros(1, 3, dtype=torch.int64), cu_rows))
    with pytest.raises(InputError, match="in_channels must be at least 1; got 0"):
        config(in_channels=0)
    with pytest.raises(InputError, match="mirror must be one of"):
        config(mirror="both")


def test_depth_of_a_pyramid_puts_rows_beyond_it_to_sleep():
    spec, zero = config().pyramid_spec(), torch.zeros(1, dtype=torch.int64)
    points = torch.tensor([[0.5, 0.5, 0.5], [7.5, 0.5, 0.5], [8.5, 0.5, 0.5]])
    origin = torch.zeros(1, 3, dtype=torch.float64)
    made = build_pyramid(points, torch.tensor([0, 3]), zero, zero, origin, spec, depth=3)
    assert made.rows.tolist() == [0, 1]
    with pytest.raises(ValueError, match=r"depth must be in \[1, 16\]"):
        build_pyramid(points, torch.tensor([0, 3]), zero, zero, origin, spec, depth=17)
    with pytest.raises(ValueError, match="depth must not be given with release"):
        spec = dataclasses.replace(spec, release=True)
        build_pyramid(points, torch.tensor([0, 3]), zero, zero, origin, spec, depth=3)
