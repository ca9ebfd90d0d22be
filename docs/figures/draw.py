#!/usr/bin/env python
"""Draws the figures of the documentation: python docs/figures/draw.py (needs matplotlib); one .svg file each."""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("svg")
from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle  # noqa: E402

HERE = Path(__file__).parent
BLUE, ORANGE, GREY, GREEN, LIGHT = "#3b6fb6", "#e08a2e", "#8a8f98", "#4f9a5b", "#dfe6f0"
plt.rcParams.update({"svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "svg.hashsalt": "gsim3d"})


def save(figure, name: str) -> None:
    figure.savefig(HERE / f"{name}.svg", bbox_inches="tight", metadata={"Date": None}, facecolor="white")
    plt.close(figure)


def canvas(width: float, height: float, x: float, y: float):
    figure, axes = plt.subplots(figsize=(width, height))
    axes.set(xlim=(0, x), ylim=(0, y), aspect="equal")
    axes.axis("off")
    return figure, axes


def box(axes, x, y, w, h, text, color=LIGHT, size=7.5):
    axes.add_patch(
        FancyBboxPatch((x, y), w, h, boxstyle="round,pad=0.02,rounding_size=0.12", fc=color, ec="#444", lw=0.8)
    )
    axes.text(x + w / 2, y + h / 2, text, ha="center", va="center", fontsize=size)


def arrow(axes, start, end, text="", above=0.14, color="#444"):
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1})
    if text:
        axes.text((start[0] + end[0]) / 2, (start[1] + end[1]) / 2 + above, text, ha="center", fontsize=8, color=color)


def architecture() -> None:
    """How data flows."""
    figure, axes = canvas(8.4, 3.6, 16.8, 7.2)
    box(axes, 0.2, 4.6, 2.4, 1.5, "Frames\nimages, masks,\ncameras")
    box(axes, 4.2, 4.6, 2.6, 1.5, "Encoder\nmulti-view stereo", "#cfe0f7")
    box(axes, 8.6, 4.6, 2.4, 1.5, "Particles\nlast T steps")
    box(axes, 8.6, 0.9, 2.4, 1.7, "Dynamics\nPoint Transformer\n+ priors", "#cfe0f7")
    box(axes, 12.6, 0.9, 2.4, 1.7, "Particles\nnext step")
    box(axes, 12.6, 4.6, 1.9, 1.5, "Gaussian\nhead", "#cfe0f7")
    box(axes, 15.0, 4.6, 1.7, 1.5, "Images\nany view")
    box(axes, 4.2, 0.9, 2.6, 1.7, "Plan\nfrom EffectsSpec:\nwhat is computed", "#f7ead2")
    arrow(axes, (2.7, 5.35), (4.1, 5.35), "encode")
    arrow(axes, (6.9, 5.35), (8.5, 5.35))
    arrow(axes, (9.8, 4.5), (9.8, 2.75))
    axes.text(9.95, 3.5, "step", fontsize=8)
    arrow(axes, (11.1, 1.75), (12.5, 1.75))
    arrow(axes, (13.3, 2.75), (11.0, 4.55), "rollout", 0.25)
    arrow(axes, (13.7, 2.75), (13.7, 4.5))
    axes.text(13.85, 3.5, "render", fontsize=8)
    arrow(axes, (14.6, 5.35), (14.95, 5.35))
    arrow(axes, (6.9, 1.75), (8.5, 1.75))
    axes.text(0.2, 6.6, "gsim3d.Simulator", fontsize=10, weight="bold")
    axes.text(0.2, 0.2, "blue: learned modules, built from gsim3d.ops (CPU and CUDA kernels)", fontsize=8, color=GREY)
    save(figure, "architecture")


def particles_and_frames() -> None:
    """Packed clouds and their offsets."""
    figure, axes = canvas(7.6, 3.0, 15.2, 6.0)
    counts, colors = (4, 3, 4, 5), ("#9dbce6", "#5f8fd0", "#f2c38c", "#e39a4a")
    names = ("scene 0\nstep 0", "scene 0\nstep 1", "scene 1\nstep 0", "scene 1\nstep 1")
    rng, offsets, x = np.random.default_rng(3), np.concatenate([[0], np.cumsum(counts)]), 0.4
    for cloud, (count, color, name) in enumerate(zip(counts, colors, names)):
        axes.add_patch(Rectangle((0.5 + 3.65 * cloud, 3.6), 3.0, 2.0, fc="none", ec=GREY, lw=0.8))
        points = rng.uniform((0.35, 0.35), (2.65, 1.3), (count, 2)) + (0.5 + 3.65 * cloud, 3.6)
        axes.scatter(*points.T, s=60, color=color, edgecolor="#444", lw=0.6)
        axes.text(0.6 + 3.65 * cloud, 5.45, name, va="top", fontsize=8)
        for _ in range(count):
            axes.add_patch(Rectangle((x, 1.9), 0.86, 0.75, fc=color, ec="#444", lw=0.6))
            x += 0.86
    for offset in offsets:
        axes.plot([0.4 + 0.86 * offset] * 2, [1.6, 2.65], color="#222", lw=1.2)
        axes.text(0.4 + 0.86 * offset, 1.25, str(offset), ha="center")
    axes.text(0.4, 2.85, "means [N, 3], opacities [N], dynamic_latents [N, C], ...", fontsize=8)
    axes.text(
        0.4, 0.65, "cu_rows = [0, 4, 7, 11, 16]   cloud_scene = [0, 0, 1, 1]   cloud_step = [0, 1, 0, 1]", fontsize=8
    )
    save(figure, "particles_and_frames")


def _hilbert(order: int) -> np.ndarray:
    """Cells [4^order, 2] along the curve."""
    points = np.zeros((1, 2), int)
    for level in range(order):
        n = 2**level
        x, y = points.T
        parts = [(y, x), (x, y + n), (x + n, y + n), (2 * n - 1 - y, n - 1 - x)]
        points = np.concatenate([np.stack(part, 1) for part in parts])
    return points


def serialization_and_patches() -> None:
    """Cells along a curve, and consecutive particles as patches."""
    figure, axes = plt.subplots(1, 3, figsize=(7.8, 2.7))
    rng, size = np.random.default_rng(1), 8
    angle = rng.uniform(0, 2 * np.pi, 34)
    points = np.stack([4 + 3.0 * np.cos(angle), 4 + 2.3 * np.sin(angle)], 1) + rng.normal(0, 0.25, (34, 2))
    curve = _hilbert(3)
    codes = {tuple(cell): i for i, cell in enumerate(curve)}
    order = np.argsort([codes[tuple(np.clip(p, 0, size - 1).astype(int))] for p in points], kind="stable")
    palette = (BLUE, ORANGE, GREEN, "#9a5fb5", GREY)
    titles = ("1. cells of the grid", "2. order along a Hilbert curve", "3. patches of consecutive particles")
    for part, (ax, title) in enumerate(zip(axes, titles)):
        ax.set(xlim=(0, size), ylim=(0, size), aspect="equal", xticks=range(size + 1), yticks=range(size + 1))
        ax.tick_params(length=0, labelbottom=False, labelleft=False)
        ax.grid(lw=0.4, color="#ccc")
        ax.set_title(title, fontsize=9)
        if part == 1:
            ax.plot(*(curve + 0.5).T, color=GREY, lw=0.8, zorder=1)
        if part == 2:
            ax.plot(*points[order].T, color="#bbb", lw=0.8, zorder=1)
        rank = np.argsort(order)
        colors = [palette[i // 8] for i in rank] if part == 2 else BLUE
        ax.scatter(*points.T, s=16, c=colors, zorder=2)
    save(figure, "serialization_and_patches")


def static_background() -> None:
    """What movable and frozen particles read in a symmetric and an asymmetric model."""
    figure, axes = canvas(7.6, 2.9, 15.2, 5.8)
    for left, title in ((0.3, "symmetric: every step reads all"), (7.9, "asymmetric: computed once, then read")):
        axes.add_patch(
            Polygon([(left, 0.8), (left + 6.6, 0.8), (left + 5.6, 1.9), (left + 1.0, 1.9)], fc="#e7e2d6", ec=GREY)
        )
        axes.scatter(left + np.linspace(1.0, 5.6, 8), [1.15, 1.5] * 4, color="#b09a6a", s=40, edgecolor="#444", lw=0.5)
        axes.scatter(
            left + np.array([2.5, 3.2, 3.9, 2.9, 3.6]),
            [3.7, 4.1, 3.7, 3.3, 3.3],
            color=BLUE,
            s=55,
            edgecolor="#444",
            lw=0.5,
        )
        axes.text(left, 5.3, title, fontsize=9, weight="bold")
        axes.text(left + 4.5, 3.9, "movable", fontsize=8, color=BLUE)
        axes.text(left + 0.1, 0.25, "frozen background", fontsize=8, color="#7a683f")
    arrow(axes, (3.2, 3.0), (3.0, 1.75))
    arrow(axes, (3.9, 1.75), (3.8, 3.0))
    arrow(axes, (11.2, 1.75), (11.2, 3.0))
    axes.text(11.4, 2.3, "cell features, keys and values", fontsize=8)
    save(figure, "static_background")


if __name__ == "__main__":
    architecture()
    particles_and_frames()
    serialization_and_patches()
    static_background()
