"""From one call to many: the steps that come out, each fed back."""

from __future__ import annotations

from collections.abc import Callable

from gsim3d.dynamics.clouds import append_step, last_steps, single_steps
from gsim3d.types import Particles


def rollout(
    predict: Callable[[Particles], Particles], history: Particles, n_steps: int, max_steps: int
) -> list[Particles]:
    """The next ``n_steps`` steps, each fed back; gradients flow through all of them.

    Args:
        predict: last steps of every scene -> the next step, or several, as :class:`Dynamics`.
        history: where to start from.
        n_steps: how many steps to predict.
        max_steps: how many steps of each scene ``predict`` is given at most.
    Returns:
        One Particles a step, one cloud a scene each; rows are those of the newest step of ``history`` throughout.
    """
    history, steps = last_steps(history, max_steps), []
    while len(steps) < n_steps:
        predicted = predict(history)
        steps += single_steps(predicted)
        history = append_step(history, predicted, max_steps)
    return steps[:n_steps]
