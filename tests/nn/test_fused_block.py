"""The written-out block against the modules that define it."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import Dynamics
from gsim3d.nn.point_transformer import Block, run_blocks
from gsim3d.ops import PyramidSpec, build_pyramid
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, make_history

CHANNELS, HEADS = 16, 2
CONFIG = dataclasses.replace(TINY, mlp_ratio=3, drop_path=0.0)


def stage_of(n_rows=90, device="cpu"):
    """Rows that share voxels, patches that are cut, two clouds."""
    g = torch.Generator().manual_seed(0)
    zero = torch.zeros(2, dtype=torch.int64, device=device)
    spec = PyramidSpec(0.1, 1, (), (), (16,), ((3,),))
    return build_pyramid(
        torch.rand(n_rows, 3, generator=g).to(device),
        torch.tensor([0, n_rows // 3, n_rows], device=device),
        zero,
        torch.tensor([0, 1], device=device),
        torch.zeros(1, 3, dtype=torch.float64, device=device),
        spec,
    ).stages[0]


def block_of(dtype=torch.float64, device="cpu", checkpointing=False):
    torch.manual_seed(0)
    block = Block(CHANNELS, HEADS, 0.0, dataclasses.replace(CONFIG, checkpointing=checkpointing))
    for norm in (block.position.norm, block.norm1, block.norm2):
        torch.nn.init.normal_(norm.weight), torch.nn.init.normal_(norm.bias)
    return block.to(device, dtype).train()


def run(block, fused, stage, dtype=torch.float64, drop=False, own_conv_input=False):
    """The result, and gradients of x and all parameters."""
    device = stage.cloud.device
    g = torch.Generator().manual_seed(1)
    x, other, cotangent = (torch.randn(stage.n_rows, CHANNELS, generator=g, dtype=torch.float64) for _ in range(3))
    x = x.to(device, dtype).requires_grad_()
    block.fused, block.drop_path = fused, 0.4 if drop else 0.0
    conv_input = x.sin() + other.to(x) if own_conv_input else x
    out = block(x, stage, 1, conv_input=conv_input, generator=torch.Generator().manual_seed(5))
    return [out.detach(), *torch.autograd.grad(out, [x, *block.parameters()], cotangent.to(out))]


def names(block):
    return ["result", "x", *(name for name, _ in block.named_parameters())]


@pytest.mark.parametrize("drop", [False, True])
@pytest.mark.parametrize("own_conv_input", [False, True])
@pytest.mark.parametrize("n_rows", [90, 5])
def test_equals_the_modules(n_rows, own_conv_input, drop, device):
    block, stage = block_of(device=device), stage_of(n_rows, device)
    plain, fused = (run(block, way, stage, drop=drop, own_conv_input=own_conv_input) for way in (False, True))
    for name, a, b in zip(names(block), fused, plain, strict=True):
        assert_close_relative_to_max(a, b, "fused_block_float64", name)


@pytest.mark.parametrize("checkpointing", [False, True])
def test_empty_input(checkpointing, device):
    block, stage = block_of(device=device, checkpointing=checkpointing), stage_of(0, device)
    out, *grads = run(block, True, stage, drop=True)
    assert out.shape == (0, CHANNELS) and grads[0].shape == (0, CHANNELS)
    for name, grad in zip(names(block)[2:], grads[1:], strict=True):
        assert not grad.any(), name
    with torch.no_grad():
        assert block(out, stage, 0).shape == (0, CHANNELS)


def test_computing_again_changes_no_bit(device):
    stage = stage_of(device=device)
    kept, again = (run(block_of(device=device, checkpointing=way), True, stage, drop=True) for way in (False, True))
    for a, b in zip(again, kept, strict=True):
        assert_same_bits(a, b)


def test_two_runs_have_the_same_bits(device):
    block, stage = block_of(torch.float32, device), stage_of(device=device)
    for a, b in zip(*(run(block, True, stage, torch.float32) for _ in range(2)), strict=True):
        assert_same_bits(a, b)


def test_no_grad_has_same_bits_and_saves_nothing(device):
    block, stage = block_of(device=device), stage_of(device=device)
    expected = run(block, True, stage)[0]
    g = torch.Generator().manual_seed(1)
    x = torch.randn(stage.n_rows, CHANNELS, generator=g, dtype=torch.float64).to(device)
    for context in (torch.no_grad, torch.inference_mode):
        with context():
            out = block(x, stage, 1)
        assert not out.requires_grad
        assert_same_bits(out, expected)


def test_changed_parameters_are_noticed_by_the_backward_pass():
    block, stage = block_of(), stage_of()
    block.fused = True
    out = block(torch.ones(stage.n_rows, CHANNELS, dtype=torch.float64), stage, 0)
    with torch.no_grad():
        block.mlp.fc1.weight.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.sum().backward()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_errs_no_more_than_the_modules(dtype, devices):
    """At most twice the error of the modules under the same autocast, against float64."""
    cuda = devices[1]
    exact = run(block_of(), False, stage_of())
    block, stage = block_of(torch.float32, cuda), stage_of(device=cuda)
    with torch.autocast("cuda", dtype):
        plain, fused = (run(block, way, stage, torch.float32) for way in (False, True))
    for name, a, b, truth in zip(names(block), fused, plain, exact, strict=True):
        assert a.dtype == torch.float32, name
        error, allowed = ((t.cpu().double() - truth).abs().max().item() for t in (a, b))
        assert error <= 2 * allowed + 1e-3 * truth.abs().max().item(), name


def test_whole_network_equals_its_modules_on_a_gpu(devices):
    history = make_history((60, 50)).to(devices[1])
    torch.manual_seed(0)
    model = Dynamics(dataclasses.replace(TINY, norm="batch")).to(devices[1]).eval()
    results = []
    for fused in (False, True):
        for module in model.modules():
            if isinstance(module, Block):
                module.fused = fused
        step = model(history)
        parameters = list(model.parameters())
        results.append(
            [step.means, *torch.autograd.grad(step.means.sum() + step.dynamic_latents.square().sum(), parameters)]
        )
    for a, b in zip(*results, strict=True):
        assert_close_relative_to_max(a, b, "fused_network_float32")


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize("sizes", [(60, 50), (0, 50), (0, 0)])
def test_residual_stream_is_float32_under_autocast(sizes, norm, dtype, device):
    """Whatever dtype the layers before the first block compute in."""
    history = make_history(sizes).to(device)
    torch.manual_seed(0)
    model = Dynamics(dataclasses.replace(TINY, norm=norm)).to(device).eval()
    seen = []
    for module in model.modules():
        if isinstance(module, Block):
            module.fused = True
            module.norm1.register_forward_pre_hook(lambda *_: pytest.fail("not fused"))
    for pool in [encoder.pool for encoder in model.net.encoder if encoder.pool is not None]:
        pool.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].dtype))
    exact = model(history)
    with torch.autocast(device.type, dtype):
        step = model(history)
    assert seen and set(seen) == {torch.float32}
    assert step.means.dtype == step.dynamic_latents.dtype == torch.float32
    assert_close_relative_to_max(step.dynamic_latents, exact.dynamic_latents, 0.1)
    for grad in torch.autograd.grad(step.means.sum() + step.dynamic_latents.square().sum(), list(model.parameters())):
        assert grad.dtype == torch.float32 and torch.isfinite(grad).all()


@pytest.mark.parametrize("fused", [False, True])
def test_blocks_take_rows_in_16_bits(fused, device):
    """As layers without a norm in float32 before them leave them."""
    block, stage = block_of(torch.float32, device), stage_of(device=device)
    block.fused = fused
    x = torch.randn(stage.n_rows, CHANNELS, generator=torch.Generator().manual_seed(1)).to(device)
    with torch.no_grad():
        expected, _ = run_blocks([block], x.bfloat16().float(), x.bfloat16().float(), stage, None)
        with torch.autocast(device.type, torch.bfloat16):
            out, _ = run_blocks([block], x.bfloat16(), x.bfloat16(), stage, None)
    assert out.dtype == torch.float32
    assert_close_relative_to_max(out, expected, 0.05)


def test_products_read_the_rounded_result(device):
    block, stage = block_of(torch.float32, device), stage_of(device=device)
    block.fused = True
    x = torch.randn(stage.n_rows, CHANNELS, generator=torch.Generator().manual_seed(1)).to(device)
    with torch.autocast(device.type, torch.bfloat16):
        wide, narrow = run_blocks([block], x, x, stage, None)
    assert wide.dtype == torch.float32
    assert narrow.dtype == (torch.bfloat16 if device.type == "cuda" else torch.float32)
    assert_same_bits(narrow, wide.to(narrow.dtype))
