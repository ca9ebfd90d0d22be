import pytest
import torch


@pytest.fixture(autouse=True, scope="module")
def small_tensors(one_thread):
    """All of them are."""


@pytest.fixture(autouse=True, scope="module")
def full_precision():
    """Convolutions of cuDNN take float32 as float32."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32 = before
