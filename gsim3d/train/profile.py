"""A trace of two training steps, for chrome://tracing and ui.perfetto.dev."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile, schedule

from gsim3d.errors import InputError

FOLDER = "profile"
SKIPPED, WARM_UP, TRACED = 1, 1, 2  # steps; the first one of a sitting is like no other


def check_profile(n_steps: int) -> None:
    """Raises InputError where too few steps are left to trace."""
    if n_steps < SKIPPED + WARM_UP + TRACED:
        raise InputError(f"--profile traces steps 3 and 4 of a sitting; this one has {n_steps}")


def profiler(out: Path, rank: int) -> profile:
    """Writes ``out/profile/process_<rank>.json`` once its ``step`` was called often enough."""
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"process_{rank}.json"

    def write(traced: profile) -> None:
        part = file.with_name(f".{file.stem}.part.json")
        traced.export_chrome_trace(str(part))
        os.replace(part, file)

    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * torch.cuda.is_available()
    plan = schedule(wait=SKIPPED, warmup=WARM_UP, active=TRACED, repeat=1)
    return profile(activities=activities, schedule=plan, on_trace_ready=write, profile_memory=True)
