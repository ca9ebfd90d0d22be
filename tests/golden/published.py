"""The published model's configurations, weights and clouds in the terms of this one, for the golden tests."""

import dataclasses

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d import ops
from gsim3d.compat.released import dynamics_weights
from gsim3d.compat.released_model import ReleasedAttention, ReleasedDynamicsConfig
from gsim3d.dynamics import DynamicsConfig
from gsim3d.nn.gaussian_head import RendererConfig
from gsim3d.nn.multiview_encoder import EncoderConfig
from gsim3d.ops import CURVES, PatchTable, Stage, curve_encode, curve_sort
from gsim3d.state import DYNAMIC, FROZEN, Particles
from tests.asserts import assert_close_relative_to_max
from tests.golden_files import Golden, published_config

NOT_IN_GOLDEN = (ReleasedAttention,)  # attention ran in float32 except where a key says fp16qkv


def dynamics_config(name: str) -> ReleasedDynamicsConfig:
    config = published_config(name)
    net, state = config["model"]["dynamic_model"]["model"], config["model"]["state_adapter"]
    assert set(state["pred_modality"].values()) == {"cx_x"} and state["pred_inductive_bias"] and net["with_time_emb"]
    return ReleasedDynamicsConfig(
        dynamic_latents=state["dynamic_latent_feature_dim"],
        static_latents=state["static_latent_feature_dim"],
        sh_degree=state["gaussians"]["sh_degree"],
        scale_min=state["gaussians"]["scale_min"],
        scale_max=state["gaussians"]["scale_max"],
        max_step=state["metric"] / 2,
        steps_per_call=config["dataset"]["n_step_predict_multiple"],
        grid_size=net["grid_size"],
        history_bits=(config["dataset"]["n_step_state"] - 1).bit_length(),
        strides=tuple(net["stride"]),
        merge_windows=tuple(net["merge_window_size"]),
        patch_sizes=tuple(net["enc_patch_size"]),
        encoder_depths=tuple(net["enc_depths"]),
        encoder_channels=tuple(net["enc_channels"]),
        encoder_heads=tuple(net["enc_num_head"]),
        decoder_depths=tuple(net["dec_depths"]),
        decoder_channels=tuple(net["dec_channels"]),
        decoder_heads=tuple(net["dec_num_head"]),
        mlp_ratio=net["mlp_ratio"],
        drop_path=net["drop_path"],
        shuffle_orders=net["shuffle_orders"],
    )


def encoder_config(name: str) -> EncoderConfig:
    model = published_config(name)["model"]
    net, state = model["encoder"], model["state_adapter"]
    return EncoderConfig(
        feature_dim=net["d_feature"],
        downscale_factor=net["downscale_factor"],
        window_split=net["multiview_trans_attn_split"],
        n_depths=net["num_depth_candidates"],
        cost_unet_dim=net["costvolume_unet_feat_dim"],
        cost_unet_levels=len(net["costvolume_unet_channel_mult"]),
        cost_unet_attention=tuple(net["costvolume_unet_attn_res"]),
        refine_unet_dim=net["depth_unet_feat_dim"],
        refine_unet_levels=len(net["depth_unet_channel_mult"]),
        refine_unet_attention=tuple(net["depth_unet_attn_res"]),
        dynamic_dim=state["dynamic_latent_feature_dim"],
        static_dim=state["static_latent_feature_dim"],
        sh_degree=state["gaussians"]["sh_degree"],
    )


def renderer_config(name: str) -> RendererConfig:
    state = published_config(name)["model"]["state_adapter"]
    return RendererConfig(
        latents=state["dynamic_latent_feature_dim"] + state["static_latent_feature_dim"],
        sh_degree=state["gaussians"]["sh_degree"],
        scale_min=state["gaussians"]["scale_min"],
        scale_max=state["gaussians"]["scale_max"],
        jacobian="clamped",
    )


def renamed(published: Golden, prefix: str = "", ours: str = "") -> dict[str, Tensor]:
    """Arrays of a part of the published network (``prefix`` is its place there) as a state dict of ours."""
    keys = [key for key in published.keys() if not key.endswith("num_batches_tracked")]
    named = dynamics_weights({prefix + key.removeprefix("net."): published[key] for key in keys})
    assert all(key.startswith(ours) for key in named)
    return {key.removeprefix(ours): value for key, value in named.items()}


def everywhere(xyz: Tensor) -> Tensor:
    """The mask [B, T, N] of clouds without masked particles."""
    return torch.ones(xyz.shape[:3], dtype=torch.bool, device=xyz.device)


def mask_of(case: Golden, xyz: Tensor, key: str = "state_mask") -> Tensor:
    return case[key][..., 0].to(xyz.device) if key in case else everywhere(xyz)


def offsets(mask: Tensor) -> Tensor:
    """mask [B, T, N] -> cu_rows of the clouds (b, t)."""
    return F.pad(mask.sum(2).flatten().cumsum(0), (1, 0))


def cloud_table(xyz: Tensor) -> tuple[Tensor, Tensor]:
    """Scene and step of the clouds of [B, T, N, 3]."""
    scene, step = torch.meshgrid(*(torch.arange(n, device=xyz.device) for n in xyz.shape[:2]), indexing="ij")
    return scene.flatten(), step.flatten()


def pyramid_of(xyz: Tensor, mask: Tensor, config: DynamicsConfig, origin: Tensor | None = None) -> ops.Pyramid:
    """The geometry of clouds [B, T, N, 3] as the published model makes it; it knows no ``origin`` [B, 3]."""
    scene, step = cloud_table(xyz)
    spec = config.pyramid_spec((xyz.shape[1] - 1).bit_length())
    origin = xyz.new_zeros(xyz.shape[0], 3) if origin is None else origin
    return ops.build_pyramid(xyz[mask], offsets(mask), scene, step, origin.double(), spec)


def particles_of(case: Golden) -> tuple[Particles, Tensor]:
    """The history below ``case``/in, and its mask [B, T, N]."""
    xyz = case["in/means"]
    mask = mask_of(case, xyz, "in/state_mask")
    moves = case["in/static_float"][..., 0] > 0 if "in/static_float" in case else everywhere(xyz)
    scene, step = cloud_table(xyz)
    history = Particles(
        means=xyz[mask],
        opacities=case["in/opacities"][mask][:, 0],
        dynamic_latents=case["in/dynamic_latent_features"][mask],
        static_latents=case["in/static_latent_features"][mask],
        cu_rows=offsets(mask),
        cloud_scene=scene,
        cloud_step=step,
        activity=torch.where(moves[mask], DYNAMIC, FROZEN).to(torch.uint8),
        origin=torch.zeros(xyz.shape[0], 3, dtype=torch.float64),
    )
    return history, mask


def assert_published_stage(stage: Stage, g: Golden, prefix: str, code_gap: int = 10) -> None:
    """Grid, clouds, codes and orders of a stage, as far as the file has them under ``prefix``; exactly.

    code_gap: unused bits between the published code's place in space and its cloud.
    """
    if prefix + "grid_coord" in g:
        assert torch.equal(stage.grid, g[prefix + "grid_coord"].long())
        assert torch.equal(stage.cloud, g[prefix + "batch"])
        assert torch.equal(stage.cu_clouds[1:], g[prefix + "offset"])
    if prefix + "batch_time_coord" in g:  # scene and slot in one number; ours are the ranks of those that occur
        assert torch.equal(torch.unique(g[prefix + "batch_time_coord"], return_inverse=True)[1], stage.cloud)
    if prefix + "serialized_code" in g:
        depth = int(g[prefix + "serialized_depth"])
        codes = [curve_encode(stage.grid, stage.cloud, c, depth=depth, shift=3 * depth + code_gap) for c in CURVES]
        assert torch.equal(torch.stack(codes), g[prefix + "serialized_code"])
        assert torch.equal(curve_sort(torch.stack(codes))[1], g[prefix + "serialized_inverse"])
    assert torch.equal(stage.order, g[prefix + "serialized_order"])


def assert_published_patches(table: PatchTable, order: Tensor, g: Golden) -> None:
    """Who attends to whom along ``order``: the same rows read in the same patches."""
    pad, unpad, ends = g["pad"], g["unpad"], g["cu_seqlens"].long()
    assert torch.equal(table.q_rows, order)
    assert torch.equal(pad[unpad], torch.arange(len(order)))
    sequences = [order[pad[a:b]].sort().values for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]
    starts, stops = table.cu_k[:-1].tolist(), table.cu_k[1:].tolist()
    read = [table.kv_rows[a:b].sort().values for a, b in zip(starts, stops, strict=True)]
    assert len(read) == len(sequences) and all(map(torch.equal, read, sequences))
    patch_of_row = torch.repeat_interleave(torch.arange(len(read)), table.cu_q.diff())
    sequence_of_slot = torch.repeat_interleave(torch.arange(len(sequences)), ends.diff())
    assert torch.equal(sequence_of_slot[unpad], patch_of_row)


def on_cpu(stage: Stage) -> Stage:
    """The parts of a stage that are compared."""
    names = ("grid", "cloud", "cu_clouds", "order")
    cluster = stage.cluster and dataclasses.replace(
        stage.cluster, rows=stage.cluster.rows.cpu(), cu_rows=stage.cluster.cu_rows.cpu()
    )
    return dataclasses.replace(stage, **{name: getattr(stage, name).cpu() for name in names}, cluster=cluster)


def members(stage: Stage) -> Tensor:
    """The cluster of each row of the stage before."""
    inverse = torch.empty(len(stage.cluster.rows), dtype=torch.int64)
    inverse[stage.cluster.rows] = torch.repeat_interleave(torch.arange(stage.n_rows), stage.cluster.cu_rows.diff())
    return inverse


def close(actual: Tensor, expected: Tensor, what: str, tolerance: float | str = "dynamics_golden") -> None:
    assert_close_relative_to_max(actual, expected, tolerance, what)


def assert_rounded_to_half(rounded: Tensor, exact: Tensor, expected: Tensor) -> None:
    """``expected`` is nearer to what this model computes with the rounding (``rounded``) than without (``exact``).

    It is not equal: a value between two halves may round either way, and what it changes goes through later blocks.
    """

    def spread(x: Tensor) -> float:
        return (x.detach() - expected).square().mean().sqrt().item()

    close(rounded, expected, "rounded to half", "half_attention_golden")
    assert spread(rounded) < 0.6 * spread(exact), (spread(rounded), spread(exact))
