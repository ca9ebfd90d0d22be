"""Convolutions over lists of cells (KernelMap.from_indices) against dense ones of torch in float64."""

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck
from torch.nn import functional as F

from gsim3d.ops import KernelMap, sparse_conv

pytestmark = pytest.mark.usefixtures("one_thread")
SIZE, BATCH, C_IN, C_OUT = 7, 2, 3, 4


def indices() -> torch.Tensor:
    """Different cells of two clouds, in any order."""
    draws = torch.rand(BATCH, SIZE, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    cells = (draws < 0.25).nonzero()
    return cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(1))]


def values(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def dense(cells: torch.Tensor, x: torch.Tensor, size) -> torch.Tensor:
    """[B, C, X, Y, Z]."""
    return x.new_zeros(BATCH, *size, x.shape[1]).index_put(tuple(cells.T), x).permute(0, 4, 1, 2, 3)


def on(device, *tensors: torch.Tensor) -> list[torch.Tensor]:
    return [t.to(device) for t in tensors]


def at(volume: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    return volume.permute(0, 2, 3, 4, 1)[tuple(cells.T)]


@pytest.mark.parametrize("kernel", [3, 1, (3, 1, 5)], ids=str)
@pytest.mark.parametrize("dilation", [1, (2, 1, 3)], ids=str)
def test_submanifold(kernel, dilation, device):
    cells, shape = indices(), (kernel,) * 3 if isinstance(kernel, int) else kernel
    x, weight, bias = values(len(cells), C_IN), values(C_OUT, *shape, C_IN), values(C_OUT)
    voxels, kernel_map = KernelMap.from_indices(cells.int().to(device), kernel, dilation=dilation)
    out = sparse_conv(*on(device, x, weight, bias), voxels, kernel_map)
    steps = (dilation,) * 3 if isinstance(dilation, int) else dilation
    padding = [k // 2 * d for k, d in zip(shape, steps, strict=True)]
    volume = F.conv3d(dense(cells, x, (SIZE,) * 3), weight.permute(0, 4, 1, 2, 3), bias, 1, padding, dilation)
    torch.testing.assert_close(out.cpu(), at(volume, cells))


STRIDED = [(2, 2, 0, 1), (3, 2, 1, 1), (3, 1, 1, 1), ((2, 3, 4), (2, 1, 3), (0, 1, 2), (1, 2, 1))]


@pytest.mark.parametrize(("kernel", "stride", "padding", "dilation"), STRIDED, ids=str)
def test_stride_and_inverse(kernel, stride, padding, dilation, device):
    cells, shape = indices(), (kernel,) * 3 if isinstance(kernel, int) else kernel
    x, weight, bias = values(len(cells), C_IN), values(C_OUT, *shape, C_IN), values(C_OUT)
    options = {"stride": stride, "padding": padding, "dilation": dilation, "spatial_shape": (SIZE,) * 3}
    voxels, kernel_map = KernelMap.from_indices(cells.to(device), kernel, **options)
    out, outputs = sparse_conv(*on(device, x, weight, bias), voxels, kernel_map).cpu(), kernel_map.outputs.cpu()
    volume = F.conv3d(dense(cells, x, (SIZE,) * 3), weight.permute(0, 4, 1, 2, 3), bias, stride, padding, dilation)
    reached = F.conv3d(
        dense(cells, torch.ones_like(x[:, :1]), (SIZE,) * 3), torch.ones(1, 1, *shape, dtype=x.dtype), None, stride,
        padding, dilation,
    )  # fmt: skip
    assert torch.equal(outputs, (reached[:, 0] > 0).nonzero())
    torch.testing.assert_close(out, at(volume, outputs))

    back, coarse = values(C_IN, *shape, C_OUT), values(len(out), C_OUT)
    out = sparse_conv(*on(device, coarse, back), None, voxels, kernel_map.inverse())
    whole = dense(outputs, coarse, volume.shape[2:])
    size = F.conv_transpose3d(whole, back.permute(4, 0, 1, 2, 3), None, stride, padding, 0, 1, dilation).shape[2:]
    rest = [SIZE - n for n in size]  # cells at the end that no output reaches from the grid's borders
    volume = F.conv_transpose3d(
        whole, back.permute(4, 0, 1, 2, 3), None, stride, padding, [max(r, 0) for r in rest], 1, dilation
    )
    torch.testing.assert_close(out.cpu(), at(volume, cells))


def test_without_spatial_shape_outputs_are_bounded_below_only(device):
    _, kernel_map = KernelMap.from_indices(torch.tensor([[0, 4, 0, 0]], device=device), 3, stride=2, padding=1)
    assert kernel_map.outputs[:, 1].tolist() == [2] and kernel_map.outputs.shape[0] == 1
    _, kernel_map = KernelMap.from_indices(torch.tensor([[0, 5, 0, 0]], device=device), 3, stride=2, padding=1)
    assert kernel_map.outputs[:, 1].tolist() == [2, 3]


def test_gradients_against_finite_differences(device):
    cells = indices()[:12].to(device)
    voxels, kernel_map = KernelMap.from_indices(cells, 2, stride=2)
    inputs = [t.requires_grad_() for t in on(device, values(12, 2), values(2, 2, 2, 2, 2), values(2))]

    def convolve(*tensors):
        return sparse_conv(*tensors, voxels, kernel_map)

    assert gradcheck(convolve, inputs, check_forward_ad=True)
    assert gradgradcheck(convolve, inputs, fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
@pytest.mark.parametrize("stride", [None, 2])
def test_16_bits_on_the_cpu_are_rounded_once(dtype, stride):
    cells = indices()
    voxels, kernel_map = KernelMap.from_indices(cells, 3, stride=stride)
    x, weight, bias = (t.to(dtype) for t in (values(len(cells), C_IN), values(C_OUT, 3, 3, 3, C_IN), values(C_OUT)))
    out = sparse_conv(x, weight, bias, voxels, kernel_map)
    assert torch.equal(out, sparse_conv(x.float(), weight.float(), bias.float(), voxels, kernel_map).to(dtype))


def test_rows_that_share_a_cell(device):
    cells = torch.tensor([[0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0]], device=device)
    voxels, kernel_map = KernelMap.from_indices(cells, 2, stride=2)
    x, weight = on(device, torch.tensor([[1.0], [3.0], [5.0]]), torch.ones(1, 2, 2, 2, 1))
    out = sparse_conv(x, weight, None, voxels, kernel_map)
    assert out.tolist() == [[7.0]]  # the mean of the first two, and the third


def test_no_cells(device):
    none, x, weight = on(device, torch.zeros(0, 4).long(), torch.zeros(0, 1), torch.ones(2, 3, 3, 3, 1))
    assert sparse_conv(x, weight, None, *KernelMap.from_indices(none, 3, stride=2)).shape == (0, 2)


def test_errors():
    cells = indices()
    for call, message in {
        r"2\^15\); got .* 32774": lambda: KernelMap.from_indices(cells + 2**15),
        r"must be odd .* got \(3, 3, 2\)": lambda: KernelMap.from_indices(cells, (3, 3, 2)),
        r"stride must be at least 1; got \(2, 0, 1\)": lambda: KernelMap.from_indices(cells, 2, stride=(2, 0, 1)),
        "indices must be an int32 or int64": lambda: KernelMap.from_indices(cells.float()),
        r"indices must be \[N, 4\]": lambda: KernelMap.from_indices(cells[:, :3]),
        r"indices must be in \[0, 2\^15\)": lambda: KernelMap.from_indices(cells - 1),
        "kernel_size must be odd": lambda: KernelMap.from_indices(cells, 2),
        "kernel_size must be at most": lambda: KernelMap.from_indices(cells, 33),
        "stride must be at least 1": lambda: KernelMap.from_indices(cells, 2, stride=0),
        "dilation must be a whole number": lambda: KernelMap.from_indices(cells, 3, dilation=1.5),
        "padding and spatial_shape are of a convolution with stride": lambda: KernelMap.from_indices(
            cells, 3, padding=1
        ),
        "and spatial_shape are of a convolution with stride": lambda: KernelMap.from_indices(
            cells, spatial_shape=(4,) * 3
        ),
        "only a convolution with stride": lambda: KernelMap.from_indices(cells)[1].inverse(),
    }.items():
        with pytest.raises((ValueError, TypeError), match=call):
            message()
    voxels, kernel_map = KernelMap.from_indices(cells, 2, stride=2)
    with pytest.raises(ValueError, match="x must be"):
        sparse_conv(torch.zeros(3, 1), torch.ones(1, 2, 2, 2, 1), None, voxels, kernel_map)
    with pytest.raises(TypeError, match="sparse_conv: voxels.row_voxel must be a tensor; got KernelMap"):
        sparse_conv(torch.zeros(len(cells), 1), torch.ones(1, 2, 2, 2, 1), None, kernel_map, voxels)
    for shape in ((3, 3, 3), (2, 2, 3)):
        with pytest.raises(ValueError, match="weight's kernel size"):
            sparse_conv(torch.zeros(len(cells), 1), torch.ones(1, *shape, 1), None, voxels, kernel_map)
