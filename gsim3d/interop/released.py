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
