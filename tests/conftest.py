"""Fixtures shared by all tests: devices are parameters of a test, never an ``if`` in its body."""

import os
from collections import defaultdict

import pytest
import torch

# A backward graph kept from an earlier run would hide that an op's backward has changed.
os.environ.setdefault("TORCHINDUCTOR_AUTOGRAD_CACHE", "0")

import gsim3d.ops  # noqa: E402, F401  (registers torch.ops.gsim3d)


def cuda_problem() -> str | None:
    """Why CUDA tests cannot run here; None when they can."""
    if not torch._C._dispatch_has_kernel_for_dispatch_key("gsim3d::pool_max", "CUDA"):
        return "CUDA not compiled"
    return None if torch.cuda.is_available() else "no CUDA GPU"


def cuda_device() -> torch.device:
    """The GPU; skips the test, or fails it with GSIM3D_REQUIRE_CUDA=1, without one."""
    problem = cuda_problem()
    if problem and os.environ.get("GSIM3D_REQUIRE_CUDA") == "1":
        pytest.fail(f"GSIM3D_REQUIRE_CUDA=1, but: {problem}")
    if problem:
        pytest.skip(problem)
    return torch.device("cuda")


def pytest_collection_modifyitems(items):
    """Marks the tests that use the GPU: ``-m gpu`` selects them.

    GSIM3D_FEW=N keeps N cases of each such test, GSIM3D_PART=I/N of them the I-th of N parts (from 0).
    """
    few = int(os.environ.get("GSIM3D_FEW", 0))
    part, n_parts = map(int, os.environ.get("GSIM3D_PART", "0/1").split("/"))
    for item in items:
        values = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if {"devices", "gpus"} & set(item.fixturenames) or any("cuda" in str(value) for value in values):
            item.add_marker(pytest.mark.gpu)
    if few:
        of_test = defaultdict(list)
        for item in items:
            if item.get_closest_marker("gpu"):
                of_test[item.path, item.originalname].append(item)
        kept = {id(case) for cases in of_test.values() for case in spread(cases, few)}
        items[:] = [item for item in items if id(item) in kept]
    items[:] = items[part::n_parts]


def spread(cases: list, n: int) -> list:
    """``n`` of them at most, from all over the list, and so that what changes fastest along it is seen to change."""
    parts = (cases[k * len(cases) // n : (k + 1) * len(cases) // n] for k in range(n))
    return [part[k % len(part)] for k, part in enumerate(parts) if part]


@pytest.fixture(params=["cpu", "cuda"])
def device(request) -> torch.device:
    """Runs the test once for each device."""
    return cuda_device() if request.param == "cuda" else torch.device("cpu")


@pytest.fixture
def devices() -> tuple[torch.device, torch.device]:
    """(cpu, cuda), for tests that compare both; skipped, or failed with GSIM3D_REQUIRE_CUDA=1, without CUDA."""
    return torch.device("cpu"), cuda_device()


@pytest.fixture
def gpus() -> tuple[torch.device, torch.device]:
    """Two GPUs of one machine, of which the first is the current one; skipped where there is one at most."""
    cuda_device()
    if torch.cuda.device_count() < 2:
        pytest.skip("one GPU")
    return torch.device("cuda:0"), torch.device("cuda:1")


@pytest.fixture(scope="module")
def one_thread():
    """Tiny tensors are fastest on one thread, the more so where several test runs share the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
