"""Published weights of Depth Anything 3 and DINOv2, from safetensors files, by name."""

import re
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from gsim3d.errors import InputError, did_you_mean
from gsim3d.nn.multiview_encoder.encoder import Encoder

# What a file may hold and the encoder does not use, by the start of its name.
SKIPPED = (
    *("model.cam_dec.", "model.gs_head.", "mask_token", "register_tokens"),
    *("embeddings.mask_token", "embeddings.register_tokens"),
)
SKIPPED_IN_HEAD = "model.head.scratch.", "_aux."  # start of the name, and what it holds
_DEPTH_ANYTHING = {
    "model.backbone.pretrained.": "backbone.", "model.head.": "depth_head.", "model.cam_enc.": "camera_encoder."
}  # fmt: skip
# Names of Hugging Face's Dinov2Model, as files and as version 5 of transformers have them.
_HUGGING_FACE = [
    (r"^embeddings\.cls_token$", "cls_token"),
    (r"^embeddings\.position_embeddings$", "pos_embed"),
    (r"^embeddings\.patch_embeddings\.projection\.", "patch_embed.proj."),
    (r"^encoder\.layer\.", "blocks."),
    (r"\.attention\.attention\.(query|key|value)\.", r".attn.\1."),
    (r"\.attention\.(q|k|v)_proj\.", r".attn.\1."),
    (r"\.attention\.(?:output\.dense|o_proj)\.", ".attn.proj."),
    (r"\.layer_scale([12])\.lambda1$", r".ls\1.gamma"),
    (r"^layernorm\.", "norm."),
]
_PARTS = [("query", "key", "value"), ("q", "k", "v")]

_Named = dict[str, tuple[str, Tensor]]  # own name -> name in the file, tensor


def load_depth_weights(encoder: Encoder, path: str | Path) -> list[str]:
    """Loads published weights into the backbone of an encoder with ``backbone: vit_dpt``.

    A file of Depth Anything 3 also sets the depth head and the camera encoder; one of DINOv2, with names of Hugging
    Face or timm, the backbone alone. Other parts keep their values.

    Args:
        encoder: changed in place; stays as it is where an error is raised.
        path: a .safetensors file.
    Returns:
        Names of tensors in the file that the encoder does not use, all from the list SKIPPED.
    Raises:
        InputError: the file cannot be read, a tensor is unknown, missing or not finite, or has another shape.
    """
    if encoder.config.backbone != "vit_dpt":
        raise InputError(f"{path}: needs an encoder with backbone vit_dpt; this one has {encoder.config.backbone}")
    if not Path(path).is_file():  # reading a pipe would never end
        raise InputError(f"{path}: no such file")
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path}: not a readable .safetensors file: {str(error).splitlines()[0]}") from None
    start, part = SKIPPED_IN_HEAD
    skipped = [name for name in tensors if name.startswith(SKIPPED) or (name.startswith(start) and part in name)]
    model, own = encoder.config.vit.model, encoder.depth.state_dict()
    found = _own_names({name: value for name, value in tensors.items() if name not in skipped}, encoder, path)
    parts = set(_DEPTH_ANYTHING.values()) if any(name.startswith("model.") for name in tensors) else {"backbone."}
    missing = sorted(name for name in own.keys() - found.keys() if name.startswith(tuple(parts)))
    for name, (in_file, value) in found.items():
        if name not in own:
            raise InputError(f"{path}: {in_file} is no weight of {model}{did_you_mean(name, own)}")
        if value.shape != own[name].shape:
            got, need = list(value.shape), list(own[name].shape)
            raise InputError(f"{path}: {in_file} is {got}, but {need} in {model}; set encoder.vit.model to its size")
        if not value.is_floating_point() or not bool(value.isfinite().all()):
            raise InputError(f"{path}: {in_file} is not of finite numbers")
    if missing:
        raise InputError(f"{path}: lacks {len(missing)} tensors that {model} needs, first {missing[0]}")
    with torch.no_grad():
        for name, (_, value) in found.items():
            own[name].copy_(value)
    return skipped


def _own_names(tensors: dict[str, Tensor], encoder: Encoder, path: str | Path) -> _Named:
    if any(name.startswith("model.") for name in tensors):
        starts = {name: next(filter(name.startswith, _DEPTH_ANYTHING), "") for name in tensors}
        return {_DEPTH_ANYTHING.get(s, "") + n.removeprefix(s): (n, tensors[n]) for n, s in starts.items()}
    start = "backbone.model." if encoder.config.vit.architecture.timm else "backbone."
    if not any(name.startswith(("embeddings.", "encoder.layer.")) for name in tensors):
        return {start + name: (name, value) for name, value in tensors.items()}
    found: _Named = {}
    for in_file, value in tensors.items():
        name = in_file
        for pattern, new in _HUGGING_FACE:
            name = re.sub(pattern, new, name)
        found[start + name] = in_file, value
    return _with_joined_products(found, path)


def _with_joined_products(found: _Named, path: str | Path) -> _Named:
    """Queries, keys and values as one matrix."""
    joined = {}
    for name, entry in found.items():
        match = re.fullmatch(r"(.*\.attn\.)(query|key|value|q|k|v)(\.\w+)", name)
        if match is None:
            joined[name] = entry
            continue
        parts = next(parts for parts in _PARTS if match[2] in parts)
        others = [f"{match[1]}{part}{match[3]}" for part in parts]
        if absent := [other for other in others if other not in found]:
            raise InputError(f"{path}: {entry[0]} needs {', '.join(parts)}; there is no {absent[0]}")
        if match[2] == parts[0]:
            joined[f"{match[1]}qkv{match[3]}"] = entry[0], torch.cat([found[other][1] for other in others])
    return joined
