"""The rows of the page: what each needs, how it is measured, and what the paper reports."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.baselines import baseline
from gsim3d.data import Scene
from gsim3d.effects.edits import Duplicate, Edit, Move, Operation, Remove, Throw, structure_of
from gsim3d.errors import InputError
from gsim3d.evaluate.physics import carried, fall_ratio, moving_points, shape_change, true_states
from gsim3d.evaluate.pictures import as_bytes, pyplot, save_figure, true_images
from gsim3d.evaluate.protocol import default_views, horizon, predict, render_steps, score_scene
from gsim3d.evaluate.scoring import PLAIN_METRICS, measurable
from gsim3d.io.files import with_parents
from gsim3d.numerics.speed import Setting
from gsim3d.profile.settings import Runner
from gsim3d.profile.sweep import BenchmarkCase, Stepping
from gsim3d.profile.timing import DeviceClock, time_call
from gsim3d.reproduce.cells import to_json
from gsim3d.train.restore import Restored

GIVEN = 4  # input steps of every method, as published
MAIN, HISTORY, CAMERAS = "Main table", "History length at inference", "Input cameras at inference"
SPEED, EDITS, TRAINED = "Speed", "Edits", "Ablations"
REPEATS = {"cpu": 1, "cuda": 5}  # timed calls, after one to warm up
EDIT_STEPS, SHOWN = 40, 6  # predicted steps of the edits, and how many of them are shown
FALL_STEPS, RAISE = 20, 0.2  # steps of the fall that is measured; metres by which the ground is raised
SUNK = 0.05  # metres below the ground, from where on a particle has gone through it
LOWEST = 0.05  # share of a body's points below the height at which it stands
EDITED: dict[str, Operation | None] = {
    "as it is": None,
    "thrown up": Throw("moving", (0.0, 0.0, 0.06)),
    "duplicated": Duplicate("moving", (0.0, 0.7, 0.2)),
    "ground removed": Remove("frozen"),
    "ground raised": Move("frozen", (0.0, 0.0, RAISE)),
}
METHODS = ("constant", "copy", "constant_velocity")  # baselines that the first model's predictions include


@dataclass(frozen=True)
class Case:
    """One model (or none) and one scene."""

    restored: Restored | None  #: the model; None for methods that are fitted to the scene
    folder: Path  #: folder of the scene
    targets: Sequence[int]  #: cameras from which all methods are scored
    n_future: int | None  #: number of predicted steps; None: to the end of the scene
    figure: Path  #: file of a picture
    device: str  #: "cpu" or "cuda"

    def scene(self) -> Scene:
        """Opens the scene. Raises InputError if the model scales its images: other rows are scored on the original."""
        if self.restored is None:
            return Scene.open(self.folder)
        scene = self.restored.open_scene(self.folder)
        if set(scene.recorded_sizes) != {(scene.width, scene.height)}:
            raise InputError(f"{self.folder}: the model takes {scene.width}x{scene.height} pixels; generate that size")
        return scene


@dataclass(frozen=True)
class Entry:
    """A row of a table."""

    table: str  #: title of the table
    row: str  #: name of the row; {model} is replaced by the model's name
    #: measures a case. Returns "scores" of :func:`gsim3d.reproduce.cells.to_json`, or "numbers" by column, and perhaps
    #: "by_scene" (scene -> value that is compared) and "figure".
    run: Callable[[Case], dict]
    paper: Mapping[str, str] = field(default_factory=dict)  #: world -> published value
    of_model: bool = True  #: whether it is measured for each model, or once for each world
    first_only: bool = False  #: whether it is measured on the first scene only
    device: str | None = None  #: device that it needs; None: any


def score(case: Case, methods: Sequence[str] = (), plain: bool = True, **setting) -> dict:
    """Scores the model under a setting, on the steps after the first ``GIVEN``.

    Args:
        methods: baselines to score, too.
        plain: leave out metrics that need weights.
        setting: options of :class:`gsim3d.numerics.speed.Setting`.
    """
    trained = case.restored.data
    if setting.get("history", 0) >= trained.history or setting.get("context_views", 0) >= trained.context_views:
        raise InputError(f"the model was trained with {trained.history} input steps of {trained.context_views} cameras")
    restored, scene = Runner(case.restored, Setting(**setting)).restored, case.scene()
    if (start := GIVEN - restored.n_encoded) < 0:
        raise InputError(f"the model needs {restored.n_encoded} input steps; all rows are given {GIVEN}")
    context, targets = default_views(restored, scene, None, case.targets)
    metrics = PLAIN_METRICS if plain else measurable()[0]
    views = {"context_cams": context, "target_cams": targets, "n_future": horizon(scene, GIVEN, case.n_future)}
    scores = score_scene(restored, scene, **views, metrics=metrics, methods=methods, start=start)
    return {"scores": to_json(scores, GIVEN)}


def fit(case: Case, name: str) -> dict:
    """Scores a baseline of :data:`gsim3d.baselines.BASELINES`, fitted to the scene."""
    scene, other = case.scene(), baseline(name, case.device)
    n_future = horizon(scene, GIVEN, case.n_future)
    other.check(scene, case.targets, GIVEN, n_future)
    given = {"target_cams": case.targets, "n_encoded": GIVEN, "n_future": n_future, "metrics": measurable()[0]}
    scores = score_scene(None, scene, **given, methods=(), others=[other])
    return {"scores": to_json(scores, GIVEN)}


def speed(case: Case) -> dict:
    """Times the encoding, and a simulated step with its images; on a GPU the step is a CUDA graph."""
    benchmark = BenchmarkCase(case.restored, [case.scene()], case.n_future)
    clock, runner = DeviceClock(benchmark.device), benchmark.runner()
    frames = benchmark.frames(runner, [0])
    repeats = REPEATS[case.device]
    encoding = time_call(lambda: runner.encode(frames), clock, repeats)
    stepping = Stepping(benchmark, Setting(captured=benchmark.device.type == "cuda"), clock)
    step = time_call(stepping, clock, repeats).split_over(stepping.span).median
    times = {"encode_ms": 1e3 * encoding.median, "step_ms": 1e3 * step, "steps_a_second": 1 / step}
    return {"numbers": {**times, "parameters": sum(value.numel() for value in case.restored.simulator.parameters())}}


def edit(case: Case) -> dict:
    """Predicts the scene with each of EDITED from the first predicted step on; draws and measures it.

    Returns:
        Numbers as far as the scene has moving particles and steps: "through", percentage of them that end below the
        ground over three edits, the others without these; shapes as rms to the rigid motion over all steps, "shape_cm"
        as it is, "true_cm" of the truth, "copies_cm" of the worst copy; "fall", the height lost without ground over
        that of free fall, after FALL_STEPS; "above_cm", how far above the raised ground the body ends.
    """
    scene, cam = case.scene(), case.targets[:1]
    context = default_views(case.restored, scene, None, case.targets)[0]
    n_given, n_future = case.restored.n_encoded, min(EDIT_STEPS, horizon(scene, GIVEN, case.n_future))
    steps = np.linspace(n_given, n_given + n_future - 1, min(SHOWN, n_future)).round().astype(int).tolist()
    rows, points, heights = {"truth": true_images(scene, cam, steps)[:, 0]}, {}, []
    for name, operation in EDITED.items():
        edits = () if operation is None else (Edit(0, operation),)
        spec = dataclasses.replace(case.restored.plan.spec, structure=structure_of(edits))
        restored = dataclasses.replace(case.restored, plan=case.restored.simulator.plan(spec))
        prediction = predict(restored, scene, context, n_future, edits=edits)
        rows[name] = as_bytes(render_steps(restored, prediction.particles, scene, cam))[steps, 0]
        points[name] = moving_points(prediction.particles, range(n_given, n_given + n_future))
        if operation is None:
            heights = [moving_points(prediction.particles, [step])[0, :, 2].mean().item() for step in range(n_given)]
    save_figure(
        strip(rows, [f"+{(step - n_given + 1) / scene.fps:.2f} s" for step in steps]), with_parents(case.figure)
    )
    return {"numbers": numbers_of_edits(points, heights, scene, n_given), "figure": case.figure.name}


def numbers_of_edits(points: Mapping[str, Tensor], heights: Sequence[float], scene: Scene, first: int) -> dict:
    """The numbers of :func:`edit`: ``points`` [S, N, 3] of each of EDITED from step ``first``, given ``heights``."""
    alone, _, copied, falling, raised = (points[name] for name in EDITED)
    if alone.shape[1] == 0:
        return {}
    body = torch.arange(copied.shape[1] // alone.shape[1]).repeat_interleave(alone.shape[1])
    ground = -math.inf if scene.ground_height is None else scene.ground_height
    on, on_copied = (moved[-1, :, 2] > ground - SUNK for moved in (alone, copied))
    above = raised[-1, :, 2] - RAISE - ground
    found = {
        "through": 100 * (~torch.cat([on, on_copied, above > -SUNK])).double().mean().item(),
        "shape_cm": 100 * shape_change(alone[:, on], body[: len(on)][on]),
        "copies_cm": 100 * shape_change(copied[:, on_copied], body[on_copied]),
        "above_cm": 100 * above.masked_fill(above < -SUNK, math.nan).nanquantile(LOWEST).item(),
    }
    if (states := true_states(scene)) is not None:
        truth, bodies = carried(alone[0], [nodes[first : first + len(alone)] for nodes in states])
        found["true_cm"] = 100 * shape_change(truth, bodies)
    if len(falling) >= FALL_STEPS:
        found["fall"] = fall_ratio(heights, falling[FALL_STEPS - 1, :, 2].mean().item(), FALL_STEPS, scene.fps)
    return {name: value for name, value in found.items() if value is not None and math.isfinite(value)}


def strip(rows: Mapping[str, np.ndarray], times: Sequence[str]):
    """Returns a figure of images [S, H, W, 3] by row, with the ``times`` of columns."""
    size = (1.6 * len(times), 1.6 * len(rows))
    figure, panels = pyplot().subplots(len(rows), len(times), figsize=size, squeeze=False, layout="constrained")
    for axes_of_row, (name, images) in zip(panels, rows.items(), strict=True):
        axes_of_row[0].set_ylabel(name)
        for axes, image, time in zip(axes_of_row, images, times, strict=True):
            axes.imshow(image)
            axes.set(xticks=[], yticks=[])
            if axes in panels[0]:
                axes.set_title(time, fontsize=9)
    return figure


_SCORED = partial(score, methods=METHODS, plain=False)
_FITTED = {"of_model": False, "device": "cuda"}
ENTRIES = (
    Entry(MAIN, "{model}", _SCORED, {"elastic": "33.15 ± 3.51", "cloth": "26.46", "rigid": "28.35"}),
    *(Entry(MAIN, name, partial(fit, name=name), **_FITTED) for name in ("spring-gaus", "spring-gaus-given")),
    Entry(
        MAIN,
        "spring-gaus-all",
        partial(fit, name="spring-gaus-all"),
        {"elastic": "24.13 ± 3.65, object 27.13 ± 3.33", "rigid": "23.85 ± 1.01, object 27.39 ± 1.47"},
        **_FITTED,
    ),
    Entry(SPEED, "{model}", speed, {"elastic": "16 to 20 steps/s, H100"}, first_only=True),
    Entry(EDITS, "{model}", edit, first_only=True),
    *(
        Entry(HISTORY, f"{{model}}, history {n}", partial(score, history=n), {"elastic": value})
        for n, value in ((2, "27.3"), (1, "22.9"))
    ),
    *(
        Entry(CAMERAS, f"{{model}}, cameras {n}", partial(score, context_views=n), {"elastic": value} if value else {})
        for n, value in ((3, "31.60, trained with 3"), (2, ""), (1, ""))
    ),
)
