"""Values that break things, and what mutates a good argument into a bad one."""

from __future__ import annotations

import math
import random
from typing import Any

import torch
from torch import Tensor

NUMBERS = (
    math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1e-45, 1e-38, -1e-38, 1e-30, 1e-12, -1.0, 2.0, 1e6, -1e6, 1e9,
    1e12, 1e15, -1e15, 1e18, 1e30, -1e30, 3.4e38, -3.4e38, 1e300, -1e300,
)  # fmt: skip
WHOLE = (
    0,
    1,
    -1,
    2,
    3,
    7,
    63,
    64,
    255,
    2**15,
    2**16,
    2**31 - 1,
    2**31,
    2**32,
    -(2**31),
    2**40,
    2**62,
    2**63 - 1,
    -(2**63),
)
DTYPES = (
    torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool,
    torch.complex64,
)  # fmt: skip
OBJECTS = (None, "text", "", 3, -1, 2.5, math.nan, True, [], [1, 2], (), {}, b"x", object)


def tensor(rng: random.Random, *shape: int, dtype=torch.float32, scale: float = 1.0) -> Tensor:
    """Random normal numbers."""
    g = torch.Generator().manual_seed(rng.getrandbits(40))
    return (scale * torch.randn(shape, generator=g, dtype=torch.float64)).to(dtype)


def mutate(value: Any, rng: random.Random) -> Any:
    """Something else in place of a good argument."""
    if isinstance(value, Tensor):
        return rng.choice(
            (_numbers, _numbers, _numbers, _numbers, _all_numbers, _dtype, _shape, _shape, _layout, _no_tensor)
        )(value, rng)
    if rng.random() < 0.15:
        return rng.choice(OBJECTS)
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return rng.choice(WHOLE)
    if isinstance(value, float):
        return rng.choice(NUMBERS)
    if isinstance(value, str):
        return rng.choice(("", "x", value.upper(), value * 1000, "\x00", "../.."))
    if isinstance(value, tuple):
        items = list(value)
        change = rng.randrange(4)
        if change == 0 or not items:
            items.append(rng.choice(WHOLE))
        elif change == 1:
            items.pop(rng.randrange(len(items)))
        else:
            place = rng.randrange(len(items))
            items[place] = mutate(items[place], rng)
        return tuple(items)
    return rng.choice(OBJECTS)


def _numbers(value: Tensor, rng: random.Random) -> Tensor:
    """A few elements become poison."""
    if value.numel() == 0:
        return _shape(value, rng)
    value = value.clone()
    flat = value.view(-1)
    for _ in range(rng.choice((1, 1, 2, 5))):
        flat[rng.randrange(len(flat))] = _number(value, rng)
    return value


def _all_numbers(value: Tensor, rng: random.Random) -> Tensor:
    """Each element becomes the same poison, or all are scaled."""
    if value.is_floating_point() and rng.random() < 0.5:
        return value * rng.choice((1e-30, 1e-12, 1e6, 1e12, 1e18, 1e30, 1e38, -1.0))
    return torch.full_like(value, _number(value, rng))


def _number(value: Tensor, rng: random.Random) -> float | int:
    if value.is_floating_point():
        number = rng.choice(NUMBERS)
        largest = torch.finfo(value.dtype).max
        return number if not math.isfinite(number) else max(-largest, min(largest, number))
    if value.dtype == torch.bool:
        return rng.random() < 0.5
    limits = torch.iinfo(value.dtype)
    near = value.view(-1)[0].item() if value.numel() else 0
    return max(limits.min, min(limits.max, rng.choice((*WHOLE, near + 1, near - 1))))


def _dtype(value: Tensor, rng: random.Random) -> Tensor:
    return value.to(rng.choice(DTYPES))


def _shape(value: Tensor, rng: random.Random) -> Tensor:
    change = rng.randrange(8)
    if change == 0 and value.dim():
        return value[:-1]
    if change == 1 and value.dim() and len(value):
        return torch.cat([value, value[-1:]])
    if change == 2:
        return value[None]
    if change == 3 and value.dim():
        return value[:0]
    if change == 4 and value.dim():
        return value[..., :0]
    if change == 5:
        return value.reshape(-1)
    if change == 6 and value.numel():
        return value.reshape(-1)[0]
    return value.mT if value.dim() > 1 else value[None, None]


def _layout(value: Tensor, rng: random.Random) -> Tensor:
    """The same numbers, stored otherwise; or none at all."""
    change = rng.randrange(6)
    if change == 0 and value.dim():
        return torch.stack([value, value], -1)[..., 0]
    if change == 1 and value.dim():
        return value.flip(0).clone().flip(0).mT.contiguous().mT if value.dim() > 1 else value.flip(0)
    if change == 2 and value.dim() and len(value):
        return value[:1].expand_as(value)
    if change == 3:
        return value.to("meta")
    if change == 4 and value.dim():
        return value.to_sparse()
    return value.detach().requires_grad_() if value.is_floating_point() else value


def _no_tensor(value: Tensor, rng: random.Random) -> Any:
    return rng.choice((*OBJECTS, value.tolist()))
