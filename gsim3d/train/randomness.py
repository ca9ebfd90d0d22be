"""Random numbers that are a function of (seed, step, sample, purpose), so that a resumed run draws the same ones."""

from __future__ import annotations

import hashlib

import torch


def generator(seed: int, step: int, sample: int, purpose: str) -> torch.Generator:
    """A fresh CPU generator; equal arguments give equal numbers, in any process and in any order of calls."""
    digest = hashlib.sha256(f"{seed}/{step}/{sample}/{purpose}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") & (2**63 - 1))
