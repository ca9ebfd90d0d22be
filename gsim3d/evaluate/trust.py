"""Calibration of the trust in predictions on scenes with known motion, and how well it holds on other scenes.

The error of a particle is its distance from where its body carries it: its last given position, bound to the nearest
nodes of the generator. Errors of encoded positions do not count.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.evaluate.physics import carried, true_states
from gsim3d.evaluate.protocol import Prediction, default_views, input_frames, predict_together
from gsim3d.evaluate.report import write_json
from gsim3d.io.terminal import progress
from gsim3d.numerics.speed import encode
from gsim3d.numerics.trust import LEAST_SPREAD, TRUST_FILE, Trust, input_measures, read_checkpoints
from gsim3d.state import DYNAMIC
from gsim3d.train.restore import Restored

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
BINS = 16  # of the scores, with equally many particles where scores differ
LEAST_ERROR = 1e-4  # metres, added to errors before their logarithm
FALSE_ALARMS = 0.01  # share of the inputs of the calibration that are out of range
LEAST_DEVIATION = 0.01, 1e-3  # of a measure, relative to its mean and in its unit: all rigs may be equal
Samples = tuple[np.ndarray, np.ndarray]  # spread and error in metres, [S, M] each


def samples(scene: Scene, prediction: Prediction) -> Samples | None:
    """Returns spread and error, [S, M] metres each, of the moving particles at each predicted step of a scene that is
    predicted from its start; None if nothing moves, or the scene has no ``states.npz``."""
    states, last = true_states(scene), prediction.n_encoded - 1
    given = prediction.step(last)
    moving = given.activity == DYNAMIC
    if states is None or not bool(moving.any()):
        return None
    truth = carried(given.means[moving].cpu(), [nodes[last : prediction.n_steps] for nodes in states])[0][1:]
    later = (prediction.step(prediction.n_encoded + step).means[moving] for step in range(len(truth)))
    error = (torch.stack(list(later)).double().cpu() - truth).norm(dim=-1)
    return prediction.spread[: len(truth), moving].double().cpu().numpy(), error.numpy()


def collect(restored: Restored, scenes: Sequence[Scene], n_future: int) -> list[Samples]:
    """Predicts scenes with their spread; returns the samples of those with known motion. Raises InputError if there is
    none."""
    shown = progress(list(scenes), "trust", unit="scene")
    made = [samples(one, predict_together(restored, [one], n_future, with_spread=True)[0]) for one in shown]
    if not (found := [pair for pair in made if pair is not None]):
        raise InputError("trust: needs scenes with moving bodies; nothing moves in those with states.npz")
    return found


def calibrate(restored: Restored, scenes: Sequence[Scene], n_future: int) -> Trust:
    """Fits bounds of errors and ranges of inputs to validation scenes.

    Inputs are measured at the first step and in the middle of each scene.

    Args:
        restored: the model.
        scenes: scenes opened by ``restored``.
        n_future: number of steps to predict.

    Raises:
        InputError: no scene has a known motion, or there are fewer than two scenes.
    """
    if len(scenes) < 2:
        raise InputError(f"trust: needs two or more scenes to calibrate; got {len(scenes)}")
    restored.simulator.trust = None  # an older calibration announces nothing here
    found = fit_bounds(collect(restored, scenes, n_future))
    inputs = [(scene, start) for scene in scenes for start in (0, (scene.n_steps - restored.n_encoded) // 2)]
    measured = [measure_scene(restored, *one) for one in inputs]
    return Trust(n_scenes=len(scenes), n_steps=n_future, **found, **fit_ranges(measured))


@torch.no_grad()
def measure_scene(restored: Restored, scene: Scene, start: int = 0) -> dict[str, float]:
    """Measures the input steps of a scene from ``start``, see :func:`gsim3d.numerics.trust.input_measures`."""
    frames = input_frames(restored, [scene], [default_views(restored, scene)[0]], start).to(restored.device)
    return input_measures(restored.simulator, frames, encode(restored.simulator, frames, (str(scene.path),)))[0]


def fit_bounds(pairs: Sequence[Samples]) -> dict:
    """Fields of :class:`Trust` that map spread and step to bounds of the error."""
    spread, step, error = flat(pairs)
    features, target = np.log([spread + LEAST_SPREAD, step]), np.log(error + LEAST_ERROR)
    fits = []  # of non-negative powers; the best one counts
    for chosen in ([], [0], [1], [0, 1]):
        design, powers = np.stack([*features[chosen], np.ones_like(target)], 1), np.zeros(2)
        solution = np.linalg.lstsq(design, target, rcond=None)[0]
        powers[chosen] = solution[:-1]
        if (powers >= 0).all():
            fits.append((((design @ solution - target) ** 2).sum(), tuple(powers)))
    powers = np.array(min(fits)[1])
    score = powers @ features
    number = np.searchsorted(np.quantile(score, np.arange(1, BINS) / BINS), score, side="right")  # of equal scores one
    bins = [number == n for n in np.unique(number)]
    quantiles = np.array([np.quantile(error[rows], LEVELS) for rows in bins])
    return {
        "spread_power": float(powers[0]),
        "step_power": float(powers[1]),
        "scores": tuple(float(score[rows].mean()) for rows in bins),
        "levels": LEVELS,
        "bounds": tuple(tuple(rising(values)) for values in quantiles.T),
    }


def rising(values: Sequence[float]) -> list[float]:
    """Isotonic regression: the rising values nearest to ``values`` in the mean square."""
    blocks: list[list[float]] = []
    for value in values:
        blocks.append([float(value), 1])
        while len(blocks) > 1 and blocks[-2][0] >= blocks[-1][0]:
            (a, n), (b, m) = blocks[-2:]
            blocks[-2:] = [[(a * n + b * m) / (n + m), n + m]]
    return [mean for mean, count in blocks for _ in range(int(count))]


def fit_ranges(measured: Sequence[dict[str, float]]) -> dict:
    """Fields of :class:`Trust` by which a share FALSE_ALARMS of the inputs, each left out of the fit, is unfamiliar."""
    names = [name for name in measured[0] if all(name in one for one in measured)]
    values = np.array([[one[name] for name in names] for one in measured])

    def fit(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, (relative, least) = rows.mean(0), LEAST_DEVIATION
        return mean, np.maximum(rows.std(0), np.maximum(relative * abs(mean), least))

    deviations = []
    for left_out, row in enumerate(values):
        mean, deviation = fit(np.delete(values, left_out, 0))
        deviations.append((abs(row - mean) / deviation).max())
    ranges = {name: (float(a), float(b)) for name, a, b in zip(names, *fit(values), strict=True)}
    return {"ranges": ranges, "threshold": float(np.quantile(deviations, 1 - FALSE_ALARMS, method="higher"))}


def risk_coverage(errors: np.ndarray, score: np.ndarray) -> float:
    """Area under the risk-coverage curve of :func:`risks`."""
    return float(risks(errors, score).mean())


def risks(errors: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Mean error of the 1, 2 ... N particles with the lowest scores: the risk-coverage curve, [N].

    Particles of equal score have no order: each counts with their mean error.
    """
    _, group, count = np.unique(score, return_inverse=True, return_counts=True)
    expected = (np.bincount(group, errors) / count)[group[np.argsort(score, kind="stable")]]
    return expected.cumsum() / np.arange(1, len(expected) + 1)


def report(trust: Trust, pairs: Sequence[Samples]) -> dict:
    """How well a calibration holds on scenes: reliability, areas of risk and coverage, errors and bounds by step.

    "risk_coverage" ranks particles of all steps together, "within_steps" those of each step, averaged over steps; in
    these the step alone has no order. "ratio_error": standard error over scenes (jackknife) of the areas' ratio, trust
    over step; empty for a single scene.
    """
    _, step, error = flat(pairs)
    spreads = [torch.from_numpy(spread) for spread, _ in pairs]
    score = np.concatenate([trust.score(spread).flatten().numpy() for spread in spreads])
    bounds = {n: np.concatenate([trust.bound(spread, n).flatten().numpy() for spread in spreads]) for n in trust.levels}
    orders, steps = {"trust": score, "step": step, "perfect": error}, range(1, int(step.max()) + 1)

    def areas(kept: np.ndarray) -> dict[str, dict[str, float]]:
        groups = {"risk_coverage": [kept], "within_steps": [kept & (step == n) for n in steps]}
        return {
            key: {name: float(np.mean([risk_coverage(error[k], by[k]) for k in group])) for name, by in orders.items()}
            for key, group in groups.items()
        }

    n, scene = len(pairs), np.repeat(np.arange(len(pairs)), [one.size for _, one in pairs])
    whole, parts = areas(scene >= 0), [areas(scene != left_out) for left_out in range(n)] if n > 1 else []
    ratios = {key: [part[key]["trust"] / part[key]["step"] for part in parts] for key in whole if parts}
    widest = bounds[max(n for n in trust.levels if n <= 0.9)]
    return {
        "n_scenes": n,
        "n_samples": len(error),
        "mean_error": float(error.mean()),
        "reliability": {str(n): float((error <= bound).mean()) for n, bound in bounds.items()},
        **whole,
        "ratio_error": {key: float((n - 1) ** 0.5 * np.std(values)) for key, values in ratios.items()},
        "by_step": {
            "error": [float(error[step == n].mean()) for n in steps],
            "bound": [float(widest[step == n].mean()) for n in steps],
        },
    }


def table(found: dict) -> str:
    """Formats :func:`report` as text."""
    lines = [f"trust, {found['n_scenes']} scenes, {found['n_samples']:,} particles and steps"]
    for key, label in (("risk_coverage", "all steps together"), ("within_steps", "within steps")):
        trust, step, perfect = (found[key][name] for name in ("trust", "step", "perfect"))
        error = f" ± {found['ratio_error'][key]:.1%}" if found["ratio_error"] else ""
        lines.append(
            f"area under the risk-coverage curve, {label}: {trust:.4f} m, by step alone {step:.4f} m "
            f"({trust / step - 1:+.1%}{error}), perfect {perfect:.4f} m ({perfect / step - 1:+.1%})"
        )
    shares = ", ".join(f"{float(level):.0%}: {share:.1%}" for level, share in found["reliability"].items())
    return "\n".join([*lines, f"share of errors within the bound of each level: {shares}"])


def save_trust(folder: Path, digest: str, trust: Trust) -> Path:
    """Writes the calibration of a checkpoint to its folder; returns the file."""
    path = folder / TRUST_FILE
    write_json(path, {**read_checkpoints(path), digest: asdict(trust)})
    return path


def flat(pairs: Sequence[Samples]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spread, step from 1, and error of all samples."""
    steps = [np.broadcast_to(np.arange(1.0, len(error) + 1)[:, None], error.shape) for _, error in pairs]
    parts = ([spread for spread, _ in pairs], steps, [error for _, error in pairs])
    return tuple(np.concatenate([values.ravel() for values in part]) for part in parts)
