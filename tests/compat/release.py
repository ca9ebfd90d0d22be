"""Files in the layout of the published release, written by the tests themselves."""

import copy
import dataclasses
from collections import OrderedDict
from pathlib import Path

import torch
import yaml

from gsim3d import presets
from gsim3d.compat.released import to_published
from gsim3d.compat.released_model import ReleasedDynamicsConfig, ReleasedModelConfig, ReleasedSimulator
from gsim3d.nn.gaussian_head import RendererConfig
from gsim3d.nn.multiview_encoder import EncoderConfig

EXPLICIT_PARAMS = ["means", "opacities", "rotations", "scales", "harmonics"]


def small_config(explicit=False, dynamic=4, static=3, **dynamics) -> ReleasedModelConfig:
    """The published architecture with few channels."""
    scales = {"scale_min": 0.004, "scale_max": 0.14}
    return ReleasedModelConfig(
        EncoderConfig(
            feature_dim=8, cnn_dims=(8, 12, 16), transformer_layers=2, n_depths=4, cost_unet_dim=8, refine_unet_dim=8,
            dynamic_dim=dynamic, static_dim=static, explicit=explicit,
        ),
        ReleasedDynamicsConfig(
            dynamic_latents=dynamic, static_latents=static, explicit=explicit, max_step=0.25, grid_size=0.05,
            history_bits=1, strides=(4, 2), merge_windows=(2, 2), patch_sizes=(32,) * 3,
            encoder_depths=(1, 2, 1), encoder_channels=(8, 16, 16), encoder_heads=(2, 4, 4),
            decoder_depths=(1, 1), decoder_channels=(8, 16), decoder_heads=(2, 4), **scales, **dynamics,
        ),
        RendererConfig(latents=0 if explicit else dynamic + static, jacobian="clamped", **scales),
    )  # fmt: skip


def full_config(preset="paper_latent", *arguments) -> ReleasedModelConfig:
    """A preset of the paper with every published oddity."""
    config = getattr(presets, preset)(*arguments)
    dynamics = ReleasedDynamicsConfig(**vars(config.dynamics))
    return ReleasedModelConfig(config.encoder, dynamics, dataclasses.replace(config.renderer, jacobian="clamped"))


def random_weights(config: ReleasedModelConfig, seed=0) -> dict[str, torch.Tensor]:
    """Published names -> values among which no two layers are alike, statistics of norms included."""
    generator = torch.Generator().manual_seed(seed)
    with torch.device("meta"):
        names = to_published(ReleasedSimulator(config).state_dict(), config)
    weights = OrderedDict()
    for name, value in names.items():
        if value.dtype == torch.int64:
            weights[name] = torch.zeros((), dtype=torch.int64)
        elif name.endswith("running_var"):
            weights[name] = torch.rand(value.shape, generator=generator) + 0.5
        else:
            weights[name] = torch.randn(value.shape, generator=generator) * max(value[0].numel(), 1) ** -0.5
    return weights


def settings_of(config: ReleasedModelConfig, image_size=32) -> dict:
    """The resolved settings that the release would have for this model."""
    encoder, dynamics, renderer = config.encoder, config.dynamics, config.renderer
    explicit = encoder.explicit
    keys = EXPLICIT_PARAMS + ["dynamic_latent_features"]
    modality = {"from_newest": "cx_x", "from_previous": "cx_dx", "absolute": "z_x"}[dynamics.predicts]
    net = {
        "in_channels": -1, "out_channels": -1, "grid_size": dynamics.grid_size,
        "order": ["z", "z-trans", "hilbert", "hilbert-trans"], "mlp_ratio": 4, "cls_mode": False,
        "temporal_merger": True, "with_time_emb": True, "merge_window_size": list(dynamics.merge_windows),
        "grid_mode": False, "stride": list(dynamics.strides), "enc_depths": list(dynamics.encoder_depths),
        "enc_channels": list(dynamics.encoder_channels), "enc_num_head": list(dynamics.encoder_heads),
        "enc_patch_size": list(dynamics.patch_sizes), "dec_depths": list(dynamics.decoder_depths),
        "dec_channels": list(dynamics.decoder_channels), "dec_num_head": list(dynamics.decoder_heads),
        "dec_patch_size": list(dynamics.patch_sizes[:-1]), "qkv_bias": True, "qk_scale": None, "drop_path": 0.3,
        "pre_norm": True, "shuffle_orders": True, "enable_rpe": False, "enable_flash": True, "pdnorm_bn": False,
        "pdnorm_ln": False,
    }  # fmt: skip
    return {
        "wandb": {"name": "run"},
        "model": {
            "encoder": {
                "name": "costvolume", "opacity_mapping": {"initial": 0.0, "final": 0.0, "warm_up": 1},
                "num_depth_candidates": encoder.n_depths, "num_surfaces": 1, "gaussians_per_pixel": 1,
                "d_feature": encoder.feature_dim, "multiview_trans_attn_split": 2,
                "costvolume_unet_feat_dim": encoder.cost_unet_dim, "costvolume_unet_channel_mult": [1, 1, 1],
                "costvolume_unet_attn_res": [4], "depth_unet_feat_dim": encoder.refine_unet_dim,
                "depth_unet_attn_res": [16], "depth_unet_channel_mult": [1] * 5, "downscale_factor": 4,
                "use_epipolar_trans": False, "wo_cost_volume": False,
            },
            "dynamic_model": {"name": "ptv3", "no_xyz": True, "model": net},
            "decoder": {"name": "mvsplat"},
            "state_adapter": {
                "fps_to_num_points": -1,
                "gaussians": {
                    "sh_degree": encoder.sh_degree, "rotations": 4, "scale_min": renderer.scale_min,
                    "scale_max": renderer.scale_max, "cam_scale_min": 0.5, "cam_scale_max": 15.0,
                },
                "state_3dgs_params": EXPLICIT_PARAMS if explicit else ["means", "opacities"],
                "dynamic_latent_feature_dim": encoder.dynamic_dim, "static_latent_feature_dim": encoder.static_dim,
                "learn_static_mask": False, "learn_background_mask": False,
                "pred_modality": dict.fromkeys(keys, modality),
                "dynamic_state_keys": EXPLICIT_PARAMS if explicit else ["means", "rotations"],
                "metric": 2 * dynamics.max_step, "immune_to_static": ["harmonics"], "pred_inductive_bias": True,
            },
        },
        "dataset": {
            "view_sampler": {
                "name": "no_replacement", "num_target_views": 5, "num_context_views": 2, "context_views": None,
                "test_context_views": [0, 2], "test_target_views": [1, 3],
            },
            "name": "genesis", "with_mask": True, "with_seg": True, "image_shape": [image_size, image_size],
            "background_color": [0.0, 0.0, 0.0], "near": 1.0, "far": 4.0, "n_step_state": 2**dynamics.history_bits,
            "n_step_state_predict": 1, "n_step_predict_multiple": dynamics.steps_per_call, "speedup": 1,
            "workspace_limits": None,
        },
    }  # fmt: skip


def changed(settings: dict, path: str, value) -> dict:
    """``settings`` with the value at a dotted path replaced; ``...`` removes it."""
    settings = copy.deepcopy(settings)
    *parents, last = path.split(".")
    section = settings
    for key in parents:
        section = section[key]
    if value is ...:
        del section[last]
    else:
        section[last] = value
    return settings


def write_release(folder: Path, weights: dict, settings: dict, **extra) -> tuple[Path, Path]:
    """(checkpoint, configuration) as Lightning and OmegaConf leave them."""
    content = {
        "epoch": 3, "global_step": 1200, "pytorch-lightning_version": "2.4.0", "state_dict": weights, "loops": {},
        "callbacks": {"ModelCheckpoint{'monitor': 'val/psnr'}": {"best_model_score": torch.tensor(33.1)}}, **extra,
    }  # fmt: skip
    torch.save(content, folder / "model.ckpt")
    (folder / "model.yaml").write_text(yaml.safe_dump(settings))
    return folder / "model.ckpt", folder / "model.yaml"
