"""Long rollouts whose gradients do not flow back to the beginning."""

from __future__ import annotations

from collections.abc import Callable

from gsim3d.dynamics import concatenate
from gsim3d.types import Particles


def in_parts(
    rollout: Callable[[Particles, int], list[Particles]], state: Particles, n_steps: int, cut: int
) -> list[Particles]:
    """``n_steps`` steps of ``rollout``; gradients flow back through ``cut`` of them at most, 0: through all."""
    steps = []
    while len(steps) < n_steps:
        part = rollout(state, min(cut or n_steps, n_steps - len(steps)))
        state = concatenate([state, *part]).detach()
        steps += part
    return steps
