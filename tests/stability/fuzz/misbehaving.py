"""Targets that do what no call may do, so that tests see the engine find it."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import torch

from tests.stability.fuzz.engine import Target, finite

BAD = 3  # the input that goes wrong


def _make(rng: random.Random, folder: Path) -> int:
    (folder / "note.txt").write_text("a file of the input")
    os.mkfifo(folder / "pipe")
    (folder / "large").touch()
    os.truncate(folder / "large", 2**32)
    return int(rng.random() * 1e6)


def _call(what: str):
    count = 0

    def call(case: int, folder: Path) -> None:
        nonlocal count
        count += 1
        if count <= BAD:
            return
        if what == "crash" and count == BAD + 1:
            os.abort()
        elif what == "hang" and count == BAD + 1:
            time.sleep(1000)
        elif what == "memory":
            torch.ones(2**28 + 2**26)  # 1.25 GiB
        elif what == "nan":
            finite({"x": [torch.tensor([1.0, float("nan")])]})
        elif what == "unnamed":
            raise ValueError("something is wrong")
        elif what == "untyped":
            raise KeyError("x")

    return call


TARGETS = [
    Target(f"_{what}", _make, _call(what), (ValueError,), lambda error, case: "x" in str(error))
    for what in ("good", "crash", "hang", "memory", "nan", "unnamed", "untyped")
]
