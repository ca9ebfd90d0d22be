"""From one call to many: the steps that come out, each fed back."""

from __future__ import annotations

from collections.abc import Callable

from gsim3d.dynamics.frozen_context import FrozenContext
from gsim3d.dynamics.partition import Partition
from gsim3d.dynamics.sleep import RestLog, Sleepers
from gsim3d.state import Particles, append_step, concatenate, last_steps, single_steps


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
        One Particles a step, one cloud a scene each; particles are those of the newest step of ``history`` throughout.
    """
    history, steps = last_steps(history, max_steps), []
    while len(steps) < n_steps:
        predicted = predict(history)
        steps += single_steps(predicted)
        history = append_step(history, predicted, max_steps)
    return steps[:n_steps]


def rollout_in_parts(
    predict: Callable[[Particles, FrozenContext | None], Particles],
    history: Particles,
    n_steps: int,
    max_steps: int,
    *,
    remember: Callable[[Particles], FrozenContext] | None = None,
    sleepers: Sleepers | None = None,
    log: RestLog | None = None,
) -> list[Particles]:
    """As :func:`rollout`, of which ``predict`` sees what moves only.

    Args:
        predict: last steps of what moves, and its background -> the next steps of what moves.
        remember: what rests -> the background that ``predict`` reads, made anew whenever others rest; None: the model
            does not tell them apart, and only whole scenes rest.
        sleepers: particles that sleep besides frozen ones; None: none.
        log: gets the numbers of computed particles.
    """
    history, steps, parts = last_steps(history, max_steps), [], None
    log = RestLog() if log is None else log
    while len(steps) < n_steps:
        if parts is None:
            asleep, begin = None, len(steps)
            if steps:  # all that the model sees was simulated when a particle first falls asleep
                history, asleep = last_steps(concatenate(steps[-max_steps:]), max_steps), sleepers.asleep
            parts = Partition.of(history, asymmetric=remember is not None, asleep=asleep)
            moving, background = parts.moving, None
            if parts.background is not None and not parts.nothing_moves:
                background = remember(parts.background)
                log.remembered += 1
            log.n_rows = parts.newest.n_rows
        predicted, others_sleep = [None], False
        if not parts.nothing_moves:
            predicted = predict(moving, background)
            moving = append_step(moving, predicted, max_steps)
            predicted = single_steps(predicted)
            log.calls += 1
        for step in predicted:
            before = steps[-1] if steps else parts.newest
            steps.append(parts.whole(step, len(steps) + 1 - begin))
            log.moving.append(parts.rows.shape[0])
            if sleepers is not None and len(steps) < n_steps:
                others_sleep |= sleepers.look(before, steps[-1])
        parts = None if others_sleep else parts
    return steps[:n_steps]
