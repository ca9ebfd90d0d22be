"""Ops and the numpy core go on in a forked child, whatever threads its parent had."""

import subprocess
import sys

import pytest

CALLS = """
import os, sys
import numpy as np
import torch
from gsim3d import Cameras, _core, ops

torch.set_num_threads(1)
rng = np.random.default_rng(0)
x, rows, cu = torch.from_numpy(rng.random((40000, 32), np.float32)), torch.arange(40000), torch.arange(0, 40001, 20)
q, few, patches = x[:4096].reshape(4096, 4, 8), torch.arange(4096), torch.arange(0, 4097, 64)
codes, one, zero = torch.from_numpy(rng.integers(0, 1000, (4, 20000))), torch.ones(32), torch.zeros(32)
first = torch.zeros(1, dtype=torch.int64)
K = torch.tensor([[[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]])
camera = Cameras(torch.eye(4)[None], K, torch.ones(1), 9 * torch.ones(1), first, width=64, height=64)
m = torch.from_numpy(rng.random((2000, 3), np.float32) + np.float32([0, 0, 2]))
shape = torch.ones(2000, 4), torch.full((2000, 3), 0.05), torch.full((2000,), 0.5)
A, b, sources = torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3), (torch.tensor([1, 0]), torch.tensor([0, 1, 2]))
CALLS = {
    "pool_mean": lambda: ops.pool_mean(x, rows, cu),
    "pool_max": lambda: ops.pool_max(x, rows, cu),
    "row_norm": lambda: ops.row_norm(x, one, zero),
    "curve_sort": lambda: ops.curve_sort(codes)[0],
    "patch_attention": lambda: ops.patch_attention(q, q, q, ops.PatchTable(few, few, patches, patches)),
    "plane_sweep": lambda: ops.plane_sweep(x.reshape(2, 16, 200, 200), A, b, torch.ones(2, 2), *sources),
    "rasterize_gaussians": lambda: ops.rasterize_gaussians(m, *shape, camera, colors=m).color,
    "core": lambda: torch.from_numpy(_core.pool_mean(x.numpy(), rows.numpy(), cu.numpy())),
}
"""


@pytest.mark.parametrize("used", [True, False], ids=["after_use", "before_use"])
def test_a_forked_child_goes_on(used):
    """And its own child. Equal bits there; each ends by itself, and the parent goes on."""
    script = f"""{CALLS}
torch.set_num_threads(2)
if {used}:
    expected = {{name: call().numpy().copy() for name, call in CALLS.items()}}

def run(depth):
    for name, call in CALLS.items():
        got = call().numpy()
        assert not {used} or got.tobytes() == expected[name].tobytes(), name
    if depth:
        wait(depth - 1)

def wait(depth):
    child = os.fork()
    if child == 0:
        try:
            run(depth)
            os._exit(0)
        except BaseException as error:
            print(repr(error), flush=True)
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0

wait(1)
run(0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_child_that_uses_the_core_ends():
    """Its pool is made anew, and the workers of its parent are not waited for."""
    script = f"""{CALLS}
CALLS["core"]()
child = os.fork()
CALLS["core"]()
if child:
    assert os.waitpid(child, 0)[1] == 0
sys.exit(0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
