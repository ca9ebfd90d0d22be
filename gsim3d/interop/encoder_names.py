"""Names of the published encoder's parameters in this one."""

import re

import torch
from torch import Tensor

# (pattern at the start of a published name, without "encoder."; what takes its place)
RULES = (
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
)
# One convolution here, two there; their channels in this order.
LATENTS = tuple(f"depth_predictor.to_mono_features.{name}_latent_features." for name in ("dynamic", "static"))


def published_encoder_state(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """State dict of :class:`gsim3d.encoder.Encoder` from published entries whose names lost their ``encoder.`` prefix.

    Raises:
        KeyError: a name that no rule knows.
    """
    state, latents = {}, {}
    for name, value in published.items():
        latent = next((i for i, prefix in enumerate(LATENTS) if name.startswith(prefix)), None)
        if latent is not None:
            latents.setdefault(name.rpartition(".")[2], {})[latent] = value
            continue
        for pattern, replacement in RULES:
            renamed, count = re.subn(f"^{pattern}", replacement, name)
            if count:
                state[renamed.replace("downsample.0.", "downsample.")] = value
                break
        else:
            raise KeyError(f"published encoder entry {name!r} is unknown")
    for kind, parts in latents.items():
        state[f"heads.to_latents.{kind}"] = torch.cat([parts[i] for i in sorted(parts)])
    return state
