"""Pooling, merging and single blocks of the dynamics network against the published ones (d_*, e_*)."""

import dataclasses

import pytest
import torch

from gsim3d.compat.released_model import as_released
from gsim3d.nn.point_transformer import Block, EncoderStage
from gsim3d.ops import pool_mean, unpool
from tests.golden.published import (
    NOT_IN_GOLDEN,
    assert_published_patches,
    assert_published_stage,
    assert_rounded_to_half,
    close,
    dynamics_config,
    everywhere,
    members,
    on_cpu,
    pyramid_of,
    renamed,
)
from tests.golden_files import golden

pytestmark = pytest.mark.golden


def pooling_config(g, stride, window):
    case = g / f"pool{stride}"
    out_channels, in_channels = case["w/proj.weight"].shape
    return dataclasses.replace(
        dynamics_config("small"), grid_size=float(g["grid_size"]), strides=(stride,), merge_windows=(window,),
        patch_sizes=(32, 32), encoder_depths=(0, 0), encoder_channels=(in_channels, out_channels),
        encoder_heads=(1, 1), decoder_depths=(0,), decoder_channels=(in_channels,), decoder_heads=(1,),
    )  # fmt: skip


def pooling_stage(g, stride, window, config):
    """Projection, pooling, norm and the merger's embedding with published weights."""
    stage = EncoderStage(1, [], config).eval()
    weights = renamed(g / f"pool{stride}/w", "enc.enc1.down.", "encoder.1.")
    if stage.merge is not None:
        weights["merge.time_embedding"] = g[f"pool{stride}/merge{window}/pos_emb"]
    stage.load_state_dict(weights)
    return stage


@pytest.mark.parametrize("stride", [2, 4])
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_pooling(file, stride):
    g = golden(f"d_pooling_merger_{file}")
    config = pooling_config(g, stride, 1)
    xyz = g["in/xyz"]
    assert (xyz.shape[1] - 1).bit_length() == int(g["point_in/time_depth"])
    first, second = pyramid_of(xyz, everywhere(xyz), config).stages
    assert_published_stage(first, g, "point_in/")
    close(xyz.reshape(-1, 3), g["point_in/coord"], "positions of the rows")

    case = g / f"pool{stride}"
    bits = stride.bit_length() - 1
    assert_published_stage(second, case, "out/", code_gap=10)
    assert int(case["out/serialized_depth"]) == int(g["point_in/serialized_depth"]) - bits
    assert int(case["out/time_depth"]) == int(g["point_in/time_depth"])
    assert torch.equal(members(second), case["out/pooling_inverse"])
    positions = pool_mean(g["point_in/coord"], second.cluster.rows, second.cluster.cu_rows)
    close(positions, case["out/coord"], "positions", "golden_float32")

    features = g["in/features"].reshape(first.n_rows, -1)
    close(features, g["point_in/feat"], "features of the rows")
    stage = pooling_stage(g, stride, 1, config)
    out, _ = stage(features, second, None)
    close(out, case["out/feat"], "features", "golden_float32")
    spread = unpool(out.detach(), second.cluster.rows, second.cluster.cu_rows, first.n_rows)
    assert torch.equal(spread, out.detach()[case["out/pooling_inverse"]])

    out, _ = stage.train()(features, second, None)
    close(out, case["train/feat"], "features in training", "golden_float32")
    close(stage.pool.norm.running_mean, case["train/running_mean_after"], "running mean", "golden_float32")
    close(stage.pool.norm.running_var, case["train/running_var_after"], "running variance", "golden_float32")


@pytest.mark.parametrize("window", [1, 2, 4, 8])
@pytest.mark.parametrize("stride", [2, 4])
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_merging(file, stride, window, device):
    g = golden(f"d_pooling_merger_{file}")
    config = pooling_config(g, stride, window)
    xyz = g["in/xyz"].to(device)
    first, second = pyramid_of(xyz, everywhere(xyz), config).stages
    case = g / f"pool{stride}" / f"merge{window}"
    merged = int(g["point_in/time_depth"]) - int(case["out/time_depth"])
    assert merged == min(window.bit_length() - 1, int(g["point_in/time_depth"]))
    assert_published_stage(on_cpu(second), case, "out/", code_gap=0 if merged else 10)
    assert (second.time_index is not None) == (merged > 0)
    if merged:
        before = g[f"pool{stride}/out/batch_time_coord"].long()
        assert torch.equal(second.time_index.cpu(), before % 2**merged)
    if "out/pooling_inverse" in case:
        assert torch.equal(members(on_cpu(second)), case["out/pooling_inverse"])
    positions = pool_mean(xyz.reshape(-1, 3), second.cluster.rows, second.cluster.cu_rows)
    close(positions, case["out/coord"], "positions", "golden_float32")
    features = g["in/features"].reshape(first.n_rows, -1).to(device)
    out, _ = pooling_stage(g, stride, window, config).to(device)(features, second, None)
    close(out, case["out/feat"], "features", "golden_float32")


def block_and_stage(g, order, without=NOT_IN_GOLDEN, device="cpu"):
    """A block with published weights, the rows' geometry and their features."""
    weights = renamed(g / f"order{order}" / "w", "enc.enc0.block0.", "encoder.0.blocks.0.")
    channels, heads = weights["norm1.weight"].shape[0], 2  # no array has the number of heads
    patch_size = int(g["cu_seqlens"].diff().max())
    config = dataclasses.replace(
        dynamics_config("small"), grid_size=float(g["grid_size"]), strides=(), merge_windows=(),
        patch_sizes=(patch_size,), encoder_depths=(1,), encoder_channels=(channels,), encoder_heads=(heads,),
        decoder_depths=(), decoder_channels=(), decoder_heads=(),
    )  # fmt: skip
    block = as_released(Block(channels, heads, 0.0, config), without).eval()
    block.load_state_dict(weights)
    xyz = g["in/xyz"].to(device)
    (stage,) = pyramid_of(xyz, everywhere(xyz), config).stages
    return block.to(device), stage, g["in/features"].reshape(-1, channels).to(device).requires_grad_()


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_block(file, order, device):
    g = golden(f"e_block_{file}")
    block, stage, x = block_and_stage(g, order, device=device)
    seen = {}
    parts = {
        "cpe_conv": block.position.conv,
        "cpe_out": block.position,
        "norm1_out": block.norm1,
        "attn_out": block.attention,
        "mlp_out": block.mlp,
    }
    for name, part in parts.items():
        part.register_forward_hook(lambda _module, _inputs, out, name=name: seen.update({name: out}))
    block.fused = False
    out = block(x, stage, order)
    seen["cpe_out"] = seen["cpe_out"] - x  # ours adds the residual in the same kernel
    case = g / f"order{order}"
    inside = [name for name in parts if name in case]
    assert inside == ({"nodup": list(parts) if order == 0 else ["attn_out"], "dup": []}[file])
    for name in inside:
        close(seen[name], case[name], name)
    block.fused = True
    for made in (out, block(x, stage, order)):
        close(made, case["out"], "out")
        (grad,) = torch.autograd.grad(made, x, g["cotangent"].to(device))
        close(grad, case["grad_features"].reshape(x.shape), "gradient")


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_block_with_attention_rounded_to_half(file, order):
    g = golden(f"e_block_{file}")
    outs = []
    for without in ((), NOT_IN_GOLDEN):
        block, stage, x = block_and_stage(g, order, without)
        outs.append(block(x, stage, order))
    assert_rounded_to_half(outs[0], outs[1], g[f"order{order}/out_fp16qkv"])


@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_geometry_of_the_block(file):
    g = golden(f"e_block_{file}")
    xyz = g["in/xyz"]
    _, stage, _ = block_and_stage(g, 0)
    assert_published_stage(stage, g, "point_in/")
    assert (xyz.shape[1] - 1).bit_length() == int(g["point_in/time_depth"])
    close(xyz.reshape(-1, 3), g["point_in/coord"], "positions of the rows")
    for table, order in zip(stage.patches, stage.order, strict=True):
        assert_published_patches(table, order, g)
