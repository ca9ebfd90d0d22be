"""The vision transformer and its depth head against tensors of Depth Anything 3's code (m_vit_dpt)."""

import json

import pytest
import torch

from gsim3d.nn.dpt import DPTHead, position_code
from gsim3d.nn.multiview_encoder.vit_depth import pose_code, relative_poses
from gsim3d.nn.vision_transformer import Architecture, CameraEncoder, ViT, rotary, rotate
from tests.asserts import assert_close_relative_to_max
from tests.golden_files import Golden, golden

pytestmark = pytest.mark.golden
TOLERANCE = 1e-5
CASES = ["two_nocam", "two_cam", "three_nocam", "three_cam", "one_native"]


def architecture(file: Golden, mono: bool = False) -> Architecture:
    about = json.loads(file.text("about"))
    vit, head = (about["mono"], about["mono"]) if mono else (about["vit"], about["dual_dpt"])
    return Architecture(
        vit["C"],
        vit["heads"],
        vit["blocks"],
        tuple(vit["out_blocks"]),
        None if mono else vit["alt_start"],
        head["features"],
        tuple(head["out_channels"]),
        mlp_ratio=vit["mlp_ratio"],
        camera_blocks=about["cam_enc"]["blocks"],
        grid=5,
        offset=0.1,
        eps=1e-5,
    )


def loaded(module: torch.nn.Module, weights: Golden, prefix: str) -> torch.nn.Module:
    names = module.state_dict()
    module.load_state_dict({name: weights[prefix + name] for name in names})
    return module


def models(file: Golden, config: Architecture) -> tuple[ViT, DPTHead]:
    vit = loaded(ViT(config), file / "w", "backbone.pretrained.")
    return vit, loaded(DPTHead(config, 1 if config.mixes_from is None else 2), file / "w", "head.")


def cameras_of(file: Golden, case: Golden, config: Architecture, size: tuple[int, int]) -> torch.Tensor:
    """Of poses as they are, not normalised."""
    viewmats, Ks = case["in/extrinsics_w2c"][0], case["in/intrinsics"][0]
    code = pose_code(viewmats, Ks, size)[None]
    assert_close_relative_to_max(code, case["pose_encoding"], TOLERANCE, "pose code")
    encoder = loaded(CameraEncoder(config.dim, config.camera_blocks), file / "w", "cam_enc.")
    tokens = encoder(code)
    assert_close_relative_to_max(tokens, case["cam_token"], TOLERANCE, "camera tokens")
    return tokens[0]


@pytest.mark.parametrize("name", CASES)
def test_depth_and_confidence(name):
    file = golden("m_vit_dpt")
    case, config = file / name, architecture(file)
    vit, head = models(file, config)
    images = case["in/images"][0]
    n_views, size = len(images), tuple(images.shape[2:])
    order = list(range(n_views))
    if "reference_view" in case:  # which the published code brings to the front
        first = int(case["reference_view"])
        order = [first, *(i for i in order if i != first)]
    back = torch.tensor(order).argsort()
    cameras = cameras_of(file, case, config, size) if "cam_token" in case else None
    tokens = vit(images[order], n_views, cameras)[back]
    for i in range(4):
        assert_close_relative_to_max(tokens[:, i], case[f"feat{i}"][0], TOLERANCE, f"tokens {i}")
    depth, confidence = head(tokens, tuple(n // 14 for n in size), size).exp().unbind(1)
    assert_close_relative_to_max(depth, case["out/depth"][0], TOLERANCE, "depth")
    assert_close_relative_to_max(confidence + 1, case["out/depth_conf"][0], TOLERANCE, "confidence")


def test_intermediates_and_gradients():
    file = golden("m_vit_dpt")
    case, config = file / "two_nocam", architecture(file)
    vit, head = models(file, config)
    seen = {}

    def note(name, module):
        module.register_forward_hook(lambda _m, inputs, output: seen.update({name: (inputs[0], output)}))

    for i, block in enumerate(vit.blocks):
        note(f"block{i}", block)
        note(f"attn{i}", block.attn)
    for name, module in head.scratch.items():
        note(f"head/{name}", module)
    for i in range(4):
        note(f"head/project{i}", head.projects[i])
        note(f"head/resized{i}", head.resize_layers[i])
    note("patch_embed", vit.patch_embed)
    images = case["in/images"][0].requires_grad_()
    logits = head(vit(images, 2), (4, 3), (56, 42))
    expected = {name: seen[name][1] for name in seen if name.startswith("head/") and f"{name}" in case}
    expected |= {f"block{i}/in": seen[f"block{i}"][0] for i in range(6)}
    expected |= {f"block{i}/attn": seen[f"attn{i}"][1] for i in range(6)}
    expected |= {f"block{i}/out": seen[f"block{i}"][1] for i in range(6)}
    expected |= {"head/logits": logits, "patch_embed": seen["patch_embed"][1].flatten(2).mT}
    expected |= {"head/output_conv2_in": seen["head/output_conv2"][0]}
    assert len(expected) > 30
    for name, value in expected.items():
        assert_close_relative_to_max(value, case[name], TOLERANCE, name)
    depth, confidence = logits.exp().unbind(1)
    loss = (depth * case["cotangent/depth"][0]).sum() + (confidence * case["cotangent/depth_conf"][0]).sum()
    weights = {f"backbone.pretrained.{name}": value for name, value in vit.named_parameters()}
    weights |= {f"head.{name}": value for name, value in head.named_parameters()}
    names = (case / "grad_w").keys()
    found = torch.autograd.grad(loss, [images, *(weights[name] for name in names)])
    for gradient, name in zip(found, ["grad/images", *(f"grad_w/{name}" for name in names)], strict=True):
        assert_close_relative_to_max(gradient, case[name].reshape(gradient.shape), TOLERANCE, name)


def test_a_view_alone():
    file = golden("m_vit_dpt")
    config, case = architecture(file, mono=True), file / "mono"
    vit, head = models(case, config)
    images = case["in/images"][0]
    tokens = vit(images)
    for i in range(4):
        assert_close_relative_to_max(tokens[:, i], case[f"feat{i}"][0], TOLERANCE, f"tokens {i}")
    assert_close_relative_to_max(head(tokens, (3, 4), (42, 56)).exp()[:, 0], case["out/depth"][0], TOLERANCE, "depth")


def test_parts():
    file = golden("m_vit_dpt")
    parts, vit = file / "prim", models(file, architecture(file))[0]
    for height, width in ((56, 42), (28, 42), (70, 70)):
        found = vit.positions((height // 14, width // 14))
        assert_close_relative_to_max(found, parts[f"pos_embed_{height}x{width}"], TOLERANCE, "position embedding")
    for h, w, c in ((4, 3, 20), (8, 6, 8)):
        code = position_code(torch.Size((c, h, w)), (56, 42), torch.float32, torch.device("cpu"))
        assert_close_relative_to_max(code, parts[f"uv_embed_H56W42_h{h}w{w}_c{c}"], TOLERANCE, "position code")
    turned = rotate(parts["rope_in"], rotary(parts["rope_pos"][0], 16))
    assert_close_relative_to_max(turned, parts["rope_out"], TOLERANCE, "rotation")
    relative, unit = relative_poses(parts["norm_ext_in"][0].double(), 3)
    assert_close_relative_to_max(relative, parts["norm_ext_out"][0].double(), TOLERANCE, "poses")
    assert_close_relative_to_max(unit, parts["norm_ext_median"].double().expand(3), TOLERANCE, "unit")
