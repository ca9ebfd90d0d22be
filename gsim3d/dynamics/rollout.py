"""Autoregressive rollouts."""

from collections.abc import Callable

from gsim3d.dynamics.frozen_context import FrozenContext
from gsim3d.dynamics.partition import Partition
from gsim3d.dynamics.sleep import RestLog, Sleepers
from gsim3d.state import Particles, append_step, concatenate, last_steps, single_steps


def rollout(
    predict: Callable[[Particles], Particles], history: Particles, n_steps: int, max_steps: int
) -> list[Particles]:
    """Predicts ``n_steps`` steps autoregressively. Gradients flow through all of them.

    Args:
        predict: last steps of every scene -> the next step or steps, as :class:`Dynamics`.
        history: initial steps.
        n_steps: steps to predict.
        max_steps: largest number of steps of a scene in the input of ``predict``.
    Returns:
        One Particles a step with one cloud a scene, with the particles of the newest step of ``history``.
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
    """:func:`rollout` in which ``predict`` advances the moving particles only, with the background.

    Args:
        predict, history, n_steps, max_steps: as :func:`rollout`.
        remember: static particles -> background, computed whenever the set of static particles changes; None: the model
            is not asymmetric, and only whole scenes may sleep.
        sleepers: decides which particles fall asleep; None: no sleep.
        log: counts computed particles.
    """
    history, steps, parts = last_steps(history, max_steps), [], None
    log = RestLog() if log is None else log
    while len(steps) < n_steps:
        if parts is None:
            asleep, begin = None, len(steps)
            if steps:  # the whole history is simulated by the first time a particle sleeps
                history, asleep = last_steps(concatenate(steps[-max_steps:]), max_steps), sleepers.asleep
            parts = Partition.of(history, asymmetric=remember is not None, asleep=asleep)
            moving, background = parts.moving, None
            if parts.background is not None and not parts.nothing_moves:
                background = remember(parts.background)
                log.remembered += 1
            log.n_rows = parts.newest.n_rows
        predicted, sleep_changed = [None], False
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
                sleep_changed |= sleepers.update(before, steps[-1])
        parts = None if sleep_changed else parts
    return steps[:n_steps]
