"""Weights of the published model under the names of this one."""

from __future__ import annotations

import re

import torch
from torch import Tensor

# Applied in this order to every name below "dynamic_model.net.".
_DYNAMICS = [
    (r"^embedding\.stem\.", "stem."),
    (r"^enc\.enc(\d+)\.", r"encoder.\1."),
    (r"^dec\.dec(\d+)\.", r"decoder.\1."),
    (r"^dec\.\d+\.", "head."),
    (r"\.block(\d+)\.", r".blocks.\1."),
    (r"\.down\.proj\.", ".pool.proj."),
    (r"\.down\.norm\.0\.", ".pool.norm."),
    (r"\.merger\.pos_emb$", ".merge.time_embedding"),
    (r"\.up\.proj\.0\.", ".unpool.proj."),
    (r"\.up\.proj\.1\.", ".unpool.proj_norm."),
    (r"\.up\.proj_skip\.0\.", ".unpool.skip."),
    (r"\.up\.proj_skip\.1\.", ".unpool.skip_norm."),
    (r"\.cpe\.0\.", ".position.conv."),
    (r"\.cpe\.1\.", ".position.linear."),
    (r"\.cpe\.2\.", ".position.norm."),
    (r"\.(norm[12])\.0\.", r".\1."),
    (r"\.attn\.", ".attention."),
    (r"\.mlp\.0\.", ".mlp."),
    (r"\.norm_pre\.", ".norm."),
]

# The first that matches the start of a name below "encoder.".
_ENCODER = [
    (r"backbone\.backbone\.layer1\.", "cnn.stages.0."),
    (r"backbone\.backbone\.layer2\.", "cnn.stages.1."),
    (r"backbone\.backbone\.layer3\.", "cnn.stages.2."),
    (r"backbone\.backbone\.", "cnn."),
    (r"backbone\.transformer\.", "transformer."),
    (r"depth_predictor\.corr_refine_net\.([01])\.", r"depth.cost_volume.refine_in.\1."),
    (r"depth_predictor\.corr_refine_net\.3\.", "depth.cost_volume.unet."),
    (r"depth_predictor\.corr_refine_net\.4\.", "depth.cost_volume.refine_out."),
    (r"depth_predictor\.regressor_residual\.", "depth.cost_volume.residual."),
    (r"depth_predictor\.depth_head_lowres\.", "depth.cost_volume.head."),
    (r"depth_predictor\.upsampler\.0\.", "depth.upsampler."),
    (r"depth_predictor\.proj_feature\.", "depth.proj_feature."),
    (r"depth_predictor\.refine_unet\.([01])\.", r"depth.refine_in.\1."),
    (r"depth_predictor\.refine_unet\.3\.", "depth.refine_unet."),
    (r"depth_predictor\.to_disparity\.", "depth.to_disparity."),
    (r"depth_predictor\.to_gaussians\.", "heads.to_gaussians."),
    (r"depth_predictor\.global_cond\.", "heads.conditioning.net."),
]
# Two convolutions there, the channels of one here.
_LATENTS = [f"depth_predictor.to_mono_features.{kind}_latent_features." for kind in ("dynamic", "static")]


def encoder_weights(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """State dict below "encoder." -> that of :class:`gsim3d.encoder.Encoder`."""
    weights = {}
    for name, value in published.items():
        if name.startswith(tuple(_LATENTS)):
            continue
        for pattern, replacement in _ENCODER:
            name, count = re.subn(f"^{pattern}", replacement, name)
            if count:
                break
        weights[name.replace(".downsample.0.", ".downsample.")] = value
    for kind in ("weight", "bias"):
        parts = [published[prefix + kind] for prefix in _LATENTS if prefix + kind in published]
        if parts:
            weights[f"heads.to_latents.{kind}"] = torch.cat(parts)
    return weights


def dynamics_weights(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """State dict below "dynamic_model.net." -> that of :class:`gsim3d.dynamics.point_transformer.PointTransformer`."""
    weights = {}
    for name, value in published.items():
        if name.endswith("num_batches_tracked"):
            continue
        for pattern, replacement in _DYNAMICS:
            name = re.sub(pattern, replacement, name)
        weights[name] = value
    return weights


def head_weights(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """State dict below "decoder." -> that of :class:`gsim3d.renderer.GaussianHead`."""
    weight = published["to_missing_3dgs.2.weight"]
    return {
        "fc1.weight": published["to_missing_3dgs.0.weight"],
        "fc1.bias": published["to_missing_3dgs.0.bias"],
        "fc2.weight": weight,
        "fc2.bias": torch.zeros_like(weight[:, 0]),
    }
