"""On a CPU the argument whose dtype all others follow is named where it is no float32 or float64, and no other."""

import pytest
import torch

from gsim3d import ops
from gsim3d.cameras import Cameras

K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
CAMERAS = Cameras(torch.eye(4)[None], K, torch.ones(1), torch.full((1,), 9.0), torch.tensor([0]), 64, 48)


def random(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def raster(means, rest):
    rows = random(2, 4), random(2, 3), random(2)
    return ops.rasterize_gaussians(means, *map(rest, rows), CAMERAS, colors=rest(random(2, 3)))


def sweep(features, rest):
    geometry = torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3), torch.ones(2, 2)
    return ops.plane_sweep(features, *map(rest, geometry), torch.tensor([1, 0]), torch.tensor([0, 1, 2]))


CALLS = {
    "means": (raster, (2, 3)),
    "features": (sweep, (2, 4, 3, 3)),
    "row_norm: x": (lambda x, rest: ops.row_norm(x, rest(random(4)), rest(random(4))), (3, 4)),
    "residual_norm: x": (lambda x, rest: ops.residual_norm(x, rest(random(3, 4))), (3, 4)),
}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int32], ids=str)
@pytest.mark.parametrize("name", CALLS)
def test_first_argument_is_named(name, dtype):
    call, shape = CALLS[name]
    call(random(*shape), lambda x: x)
    for rest in (lambda x: x.to(dtype), lambda x: x):
        with pytest.raises(ValueError, match=f"{name} must be float32 or float64; got {str(dtype)[6:]}$"):
            call((9 * random(*shape)).to(dtype), rest)
