"""The figures of the report, as PNG files in memory."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from math import log10
from textwrap import wrap

from gsim3d.evaluate.pictures import pyplot
from gsim3d.profile.budget import Training
from gsim3d.profile.measure import Comparison, Point, disagreement, front
from gsim3d.profile.settings import KINDS, NOT_TUNED
from gsim3d.profile.timing import STAGES

COLORS = {"exact": "#2e8b57", "near-exact": "#1f5fbf", "model": "#c0504d", "needs-training": "#8064a2"}
STAGE_COLORS = (
    "#4c72b0",
    "#dd8452",
    "#55a868",
    "#c44e52",
    "#8172b3",
    "#937860",
    "#da8bc3",
    "#8c8c8c",
    "#ccb974",
    "#eeeeee",
)
GREY, RED = "#a8a8a8", "#c00000"
AXES = {
    "agreement": ("PSNR against the reference [dB]", lambda p: p.agreement.psnr if p.agreement else None),
    "task": ("PSNR against the truth [dB]", lambda p: p.task.get("psnr_masked", p.task.get("psnr"))),
}
PROMISED = {0.999: "99.9 % kept", 0.99: "99 % kept"}
LEAST_LOSS, MOST_LOSS = 1e-4, 3.0  # of the gain; what is lost less, or won, and what is lost more is drawn there
DPI = 110


def on_front(points: Sequence[Point], axis: str) -> list[Point]:
    """Those that no other point beats in both time and the error of ``axis``."""
    if axis == "agreement":
        return front(points, disagreement)
    value = AXES[axis][1]
    return front(points, lambda p: None if value(p) is None else -value(p))


def cost(points: Sequence[Point], comparison: Comparison, presets: dict[str, Point]) -> bytes:
    """What each share of the accuracy costs: the lost share of the reference's gain against the time of a step."""
    shares = {id(p): comparison.share_kept(p, points[0]) for p in points if not p.failure}
    usable = [p for p in points if shares.get(id(p)) is not None]

    def lost(point: Point) -> float:
        return min(MOST_LOSS, max(LEAST_LOSS, 1 - shares[id(point)]))

    figure, axes = pyplot().subplots(figsize=(9.5, 6.4), layout="constrained")
    best = front([p for p in usable if p.knob not in NOT_TUNED], lost)
    _draw(axes, points, usable, best, lost, labelled=[p for p in best if p not in presets.values()])
    axes.set_ylabel("share of the gain that is lost")
    axes.autoscale(enable=False, axis="y")  # of equal losses there is no range to scale to
    axes.set_ylim(LEAST_LOSS / 1.8, 12 * MOST_LOSS)  # room for what is said of the presets
    ticks = {LEAST_LOSS: "none", 1e-3: "0.1 %", 1e-2: "1 %", 0.1: "10 %", 1.0: "100 %", MOST_LOSS: "more"}
    axes.set_yticks(list(ticks), list(ticks.values()))
    axes.minorticks_off()
    _plain_times(axes)
    for share, text in PROMISED.items():
        axes.axhline(1 - share, color="#444444", linewidth=1, linestyle="--", zorder=1)
        axes.text(1.005, 1 - share, text, transform=axes.get_yaxis_transform(), va="center", fontsize=9)
    axes.axhspan(LEAST_LOSS / 1.8, LEAST_LOSS * 1.25, color="#eef5ee", zorder=0)
    _mark_presets(axes, presets, points[0], lost, shares)
    gain = comparison.gain(points[0].by_step)
    whole = "" if gain is None else f" (the gain: {gain:.2f} dB over particles held still)"
    axes.set_title(f"What 99.9 % and 99 % of the model's gain cost{whole}", fontsize=11)
    return _png(figure)


def _mark_presets(axes, presets: dict[str, Point], reference: Point, lost, shares: dict[int, float | None]) -> None:
    named: dict[int, tuple[Point, list[str]]] = {}
    for name, point in presets.items():
        if shares.get(id(point)) is not None:
            named.setdefault(id(point), (point, []))[1].append(name)
    for place, (point, names) in enumerate(sorted(named.values(), key=lambda found: found[0].step_seconds)):
        x, y = 1e3 * point.step_seconds, lost(point)
        faster = reference.step_seconds / point.step_seconds
        axes.plot(x, y, "*", color="#e0a030", markersize=18, markeredgecolor="#444444", zorder=5)
        text = f"{' = '.join(names)}: {x:.3g} ms a step"
        if point is not reference:
            kept = f"keeps {100 * min(1, shares[id(point)]):.2f} %, {faster:.2f} times as fast"
            text = "\n".join([text, *wrap(point.setting.name, 36), kept])
        axes.annotate(
            text, (x, y), (0.015 + 0.345 * place, 0.98), textcoords="axes fraction", va="top", fontsize=8.5,
            zorder=6,
            bbox={"boxstyle": "round", "facecolor": "#fff8e8", "edgecolor": "#e0a030"},
            arrowprops={"arrowstyle": "-", "color": "#e0a030", "linewidth": 1},
        )  # fmt: skip


def scatter(points: Sequence[Point], axis: str) -> bytes:
    """Error against time, both on logarithmic axes; failures at the right edge."""
    label, value = AXES[axis]
    figure, axes = pyplot().subplots(figsize=(9.5, 6.2), layout="constrained")
    usable = [p for p in points if not p.failure and value(p) is not None]
    best = on_front(points, axis)

    def error(point: Point) -> float:
        return 10 ** (-value(point) / 20)

    _draw(axes, points, usable, best, error, labelled=best)
    axes.set_ylabel("root mean squared error of images")
    _plain_times(axes)
    second = axes.secondary_yaxis("right", functions=(_decibel, _error))
    second.set_ylabel(label)
    low, high = (_decibel(y) for y in reversed(axes.get_ylim()))
    step = next(step for step in (0.1, 0.2, 0.5, 1, 2, 5, 10) if (high - low) / step <= 12)
    ticks = [n * step for n in range(int(low / step) + 1, int(high / step) + 1)]
    second.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    second.minorticks_off()
    return _png(figure)


def _draw(axes, points: Sequence[Point], usable, best, error: Callable[[Point], float], labelled) -> None:
    """Points, the front through them, and what failed at the edge; numbers are those of the table."""
    number = {id(p): n for n, p in enumerate(points)}
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time of a simulated step and its images [ms]; bars: rounds differ by so much",
    )
    placed: list[tuple[float, float]] = []
    for point in sorted(usable, key=lambda p: (p not in labelled and p is not points[0], p.step_seconds)):
        chosen = point in best or point is points[0]
        x, y, color = 1e3 * point.step_seconds, error(point), COLORS[point.kind] if chosen else GREY
        axes.plot(x, y, "o", color=color, markersize=8 if chosen else 5, zorder=4 if chosen else 3)
        axes.errorbar(x, y, xerr=500 * point.spread, fmt="none", ecolor="#d0d0d0", zorder=2)
        text = f"{number[id(point)]}" + (f" {point.setting.name}" if point in labelled or point is points[0] else "")
        at = log10(x), log10(y)
        near = sum(abs(at[0] - a) < 0.1 and abs(at[1] - b) < 0.15 for a, b in placed)
        placed.append(at)
        place = {"xytext": (5, 4 + 9 * near), "textcoords": "offset points", "fontsize": 8 if chosen else 7}
        axes.annotate(text, (x, y), **place, color=color, zorder=4)
    line = sorted((1e3 * p.step_seconds, error(p)) for p in best)
    axes.plot(*zip(*line), "-", color="#444444", linewidth=1, zorder=2)
    failed = [p for p in points if p.failure]
    for n, point in enumerate(failed):
        text = f"failed: {number[id(point)]} {point.setting.name}: {point.failure[:60]}"
        axes.text(0.995, 0.02 + 0.035 * n, text, transform=axes.transAxes, ha="right", fontsize=7, color=RED)
        axes.plot(1.0, 0.03 + 0.035 * n, "x", color=RED, transform=axes.transAxes, clip_on=False, markersize=5)
    for kind in dict.fromkeys(p.kind for p in points):
        axes.plot([], [], "o", color=COLORS[kind], label=f"{kind}: {KINDS[kind]}")
    axes.plot([], [], "o", color=GREY, label="beaten by another in both; numbers: see the table")
    axes.legend(fontsize=7.5, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))


def _plain_times(axes) -> None:
    """Milliseconds as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _decibel(error):
    import numpy as np

    return -20 * np.log10(np.maximum(error, 1e-12))


def _error(decibel):
    return 10 ** (-decibel / 20)


def stages(points: Sequence[Point]) -> bytes:
    """Where the time of a step goes."""
    shown = [(n, p) for n, p in enumerate(points) if not p.failure and p.stages()]
    figure, axes = pyplot().subplots(figsize=(9.5, 1.4 + 0.28 * len(shown)), layout="constrained")
    left = [0.0] * len(shown)
    for name, color in zip(STAGES, STAGE_COLORS, strict=True):
        widths = [1e3 * p.stages().get(name, 0.0) for _, p in shown]
        if any(widths):
            axes.barh(range(len(shown)), widths, left=left, color=color, label=name)
            left = [a + b for a, b in zip(left, widths)]
    axes.set_yticks(range(len(shown)), [f"{n} {p.setting.name}" for n, p in shown], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("time of a step, by stage [ms]")
    axes.legend(fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.4, 1))
    return _png(figure)


def horizon(points: Sequence[Point], comparison: Comparison, presets: dict[str, Point]) -> bytes:
    """How the error against the truth grows with the horizon: of the reference and the presets."""
    figure, axes = pyplot().subplots(figsize=(9.5, 4.5), layout="constrained")
    for point in dict.fromkeys([points[0], *presets.values()]):
        metric = "psnr_masked" if "psnr_masked" in point.by_step else "psnr"
        every = point.setting.every
        names = [name for name, chosen in presets.items() if chosen is point and name != "exact"]
        label = point.setting.name + (f" ({', '.join(names)})" if names else "")
        _curve(axes, point.by_step[metric], every, label=label, linewidth=2.6 if point is points[0] else 1.3)
    metric = "psnr_masked" if "psnr_masked" in comparison.constant else "psnr"
    _curve(axes, comparison.constant[metric], 1, label="particles held still", color=GREY, linestyle="--")
    axes.set(xlabel="predicted step", ylabel=AXES["task"][0])
    axes.legend(fontsize=8)
    return _png(figure)


def _curve(axes, values: Sequence[float | None], every: int, **style) -> None:
    known = [float("nan") if v is None else v for v in values]
    axes.plot([1 + every * n for n in range(len(known))], known, **style)


def training(log: Training) -> bytes:
    """PSNR against hours of training."""
    figure, axes = pyplot().subplots(figsize=(9.5, 4.5), layout="constrained")
    for values, label, color in ((log.past, "given steps", GREY), (log.future, "simulated steps", COLORS["model"])):
        if any(v == v for v in values):
            axes.plot(log.hours, values, color=color, label=f"PSNR of {label}")
    reached = log.hours_to(0.99)
    axes.set_xlim(0, 1.02 * log.hours[-1])
    if reached is not None:
        side = "right" if reached > 0.5 * log.hours[-1] else "left"
        axes.axvline(reached, color="#444444", linewidth=1, linestyle="--")
        text = f" 99 % of the last PSNR after {reached:.3g} h "
        axes.text(reached, 0.02, text, transform=axes.get_xaxis_transform(), fontsize=8, ha=side)
    axes.set(xlabel="hours of training", ylabel="PSNR on training scenes [dB]")
    axes.legend(fontsize=8)
    return _png(figure)


def _png(figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DPI)
    pyplot().close(figure)
    return data.getvalue()
