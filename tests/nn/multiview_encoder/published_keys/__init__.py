"""Names and shapes of the tensors of published depth networks, and state dicts with these names."""

import re
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor


class Key(NamedTuple):
    """A tensor of a file.

    Attributes:
        name: in the file.
        shape: of the tensor.
        use: "yes", "if_cameras", "skip", or "tied" (skipped, and left out by some files).
        own: for Hugging Face's names, that of timm with its rows.
    """

    name: str
    shape: tuple[int, ...]
    use: str
    own: str = ""


def keys_of(file: str) -> list[Key]:
    """Of a list beside this module; <a-b> stands for every number from a to b."""
    keys = []
    for line in (Path(__file__).parent / f"{file}.txt").read_text().splitlines():
        span = re.search(r"<(\d+)-(\d+)>", line)
        lines = [line]
        if span:
            lines = [line.replace(span[0], str(i)) for i in range(int(span[1]), int(span[2]) + 1)]
        for name, shape, *rest in (each.split(" ") for each in lines):
            keys.append(Key(name, tuple(map(int, shape.strip("[]").split(","))), *rest))
    return keys


def state_dict_of(keys: list[Key], dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Random numbers, other ones for every name."""
    generator = torch.Generator().manual_seed(0)
    return {key.name: torch.rand(key.shape, generator=generator).to(dtype) for key in keys}
