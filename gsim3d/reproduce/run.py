"""Implementation of ``gsim3d reproduce``: measures what is missing within a budget, and writes the page."""

import math
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from gsim3d import pretrained
from gsim3d.data import find_scenes
from gsim3d.errors import CaptureError, FitWarning, InputError, NumericalError
from gsim3d.evaluate.ablations import Row as Ablation, Study, base_run, load_ablations
from gsim3d.evaluate.pictures import pyplot
from gsim3d.evaluate.protocol import default_views
from gsim3d.evaluate.scoring import measurable
from gsim3d.io.files import output_path, sha256_of
from gsim3d.io.machine import machine
from gsim3d.io.settings import to_dict
from gsim3d.reproduce import page
from gsim3d.reproduce.cells import Cells
from gsim3d.reproduce.entries import ENTRIES, MAIN, SPEED, TRAINED, Case, Entry
from gsim3d.synth import generate
from gsim3d.synth.held_out import SETS, origin_of
from gsim3d.synth.worlds import build_world
from gsim3d.synth.writer import scene_folder
from gsim3d.train.config import TrainConfig
from gsim3d.train.restore import Restored, restore
from gsim3d.train.run import run_folder

WORLDS = ("elastic", "cloth", "rigid")
SEED = SETS["validation"][0]
TRAINING = "-train"  # ending of the folder of a world's training set
NO_TIME = "the budget ended"

Models = dict[str, dict[str, Restored]]  # world -> name -> model


@dataclass(frozen=True)
class Job:
    """The options of ``gsim3d reproduce``."""

    out: str  #: folder of sets, cells, page and figures; created, or continued
    #: "[WORLD=]CHECKPOINT"; without WORLD scored in all worlds. None: the shipped simulators.
    models: Sequence[str] = ()
    worlds: Sequence[str] | None = None  #: worlds; None: those of ``data``, else WORLDS
    data: str | None = None  #: folder with a folder of scenes for each world; None: sets are generated in ``out``
    trajectories: int = 6  #: number of scenes of each world
    steps: int | None = None  #: number of steps to predict; None: to the end
    budget: float | None = None  #: minutes; None: unlimited. What is being measured when it ends is completed.
    train: int | None = None  #: optimizer steps of each ablation (0: those of the base run); None: nothing is trained
    preset: str | None = None  #: base run of the ablations; None: PRESET of :mod:`gsim3d.evaluate.ablations`
    device: str = "cpu"  #: "cpu" or "cuda"


@dataclass
class Row:
    """A row of a table, and what is known of it."""

    table: str  #: title of the table
    label: str  #: name of the row
    world: str  #: its world
    model: str  #: name of the model; "" for a method that is fitted to each scene
    paper: str = ""  #: published value
    seed: int | None = None  #: seed of the scenes, or of the training; None: unknown
    cells: dict[str, dict] = field(default_factory=dict)  #: scene -> cell
    before: dict[str, dict] = field(default_factory=dict)  #: scene -> the cell that it replaced
    missing: dict[str, str] = field(default_factory=dict)  #: scene -> reason


def reproduce(job: Job, command: str, say: Callable[[str], None] = print) -> tuple[dict, list[Path]]:
    """Measures what is missing in ``job.out`` and writes the page.

    Args:
        command: command line to record.
        say: called with a line for each measurement.

    Returns:
        The content of reproduce.json, and the paths of the page and its figures.

    Raises:
        InputError: an option is invalid, a checkpoint cannot be read, or a package is missing.
    """
    pyplot()
    out = output_path(job.out)
    worlds = _worlds(job)
    models = _models(job, worlds)
    if job.train is None and job.preset is not None:
        raise InputError("--preset: is the base run of --train, which is not given")
    base = None if job.train is None else base_run(load_ablations()[0], job.preset, n_steps=job.train or None)
    with run_folder(out):
        run = _Run(job, out, say)
        run.score(models)
        for world in worlds if base else ():
            if trained := run.train(world, base):
                run.score({world: {"trained here": trained}})
        return page.write(out, list(run.rows.values()), {"command": command, **machine(torch.device(job.device))})


def _worlds(job: Job) -> list[str]:
    known = WORLDS
    if job.data is not None:
        if not (data := Path(job.data)).is_dir():
            raise InputError(f"--data: {data} is not a folder")
        known = sorted(p.name for p in data.iterdir() if p.is_dir() and not p.name.endswith(TRAINING))
        known = [name for name in known if not name.startswith(".")]
    for world in job.worlds or ():
        if world not in known:
            raise InputError(f"--worlds: {world!r} does not exist; choose from {', '.join(known) or 'none'}")
    if not (job.worlds or known):
        raise InputError(f"--data: {job.data} has no folder of a world, such as {job.data}/{WORLDS[0]}")
    return list(job.worlds or known)


def _models(job: Job, worlds: Sequence[str]) -> Models:
    given = job.models or [f"{w}={n}" for w in worlds for n in pretrained.names() if n.startswith(f"{w}-")]
    found: Models = {world: {} for world in worlds}
    for text in given:
        world, _, path = text.rpartition("=") if re.match(r"[\w-]+=", text) else ("", "", text)
        if world and world not in found:
            raise InputError(f"{text}: {world!r} is not among the worlds {', '.join(worlds)} (--worlds)")
        named, restored = Path(path), restore(path, job.device)
        name = named.parent.name if named.name == pretrained.WEIGHTS else named.name.removesuffix(".safetensors")
        for each in [world] if world else worlds:
            if name in found[each]:
                raise InputError(f"{text}: there are two models named {name}; rename a folder")
            found[each][name] = restored
    if empty := [world for world in worlds if not found[world]]:
        raise InputError(f"no model of {empty[0]}: give {empty[0]}=CHECKPOINT, or leave it out with --worlds")
    return found


class _Run:
    """One call of the command: what is measured, what is known, and what is missing."""

    def __init__(self, job: Job, out: Path, say: Callable[[str], None]):
        self.job, self.out, self.say, self.rows = job, out, say, {}
        self._end = time.monotonic() + 60 * (math.inf if job.budget is None else job.budget)
        self._cells, self._costs, self._first = Cells(out), {}, {}
        facts = machine(torch.device(job.device))
        self._code = {name: facts[name] for name in ("sources", "torch")}
        self._machine = {name: facts[name] for name in ("device", "processor") if name in facts}

    def score(self, models: Models) -> None:
        """Measures the entries scene by scene, so that a short budget gives all rows of few scenes."""
        for number in range(self.job.trajectories):
            for world, named in models.items():
                if number >= self._count(world):
                    continue
                self._first.setdefault(world, next(iter(named.values())))
                folder = self._scene(world, number)
                for entry in ENTRIES:
                    if number and entry.first_only:
                        continue
                    for name, restored in named.items() if entry.of_model else [("", None)]:
                        row = self._row(entry.table, entry.row.format(model=name), world, name, entry.paper)
                        self._score(row, entry, folder, restored)

    def _score(self, row: Row, entry: Entry, folder: Path | None, restored: Restored | None) -> None:
        needs = f"needs --device {entry.device}" if entry.device and entry.device != self.job.device else None
        if folder is None:
            row.missing["scene"] = needs or NO_TIME
            return
        job, scene = self.job, folder.relative_to(self._root(row.world)).as_posix()
        origin, file = origin_of(folder), folder / "metadata.json"
        row.seed = origin.seed if origin else None

        def run() -> dict:
            if row.table != MAIN or row.cells:  # what is fitted to a model is printed once
                warnings.simplefilter("ignore", FitWarning)
            figure = self.out / "figures" / re.sub(r"\W+", "-", f"{row.world} {row.label} {row.table}".lower())
            return entry.run(Case(restored, folder, targets, job.steps, figure.with_suffix(".png"), job.device))

        try:
            targets = self._targets(row.world, folder)
        except InputError as error:
            row.missing[scene] = str(error)
            return
        asked = {
            "weights": restored and restored.checkpoint.digest,
            "scene": sha256_of(file) if file.is_file() else str(folder),
            "targets": list(targets),
            "steps": job.steps,
            "metrics": list(measurable()[0]) if row.table == MAIN else None,
        }
        cost = self._costs.get((entry.table, entry.row), 0)
        self._measure(row, scene, asked, run, needs or (NO_TIME if time.monotonic() + cost > self._end else None))
        if scene in row.cells:
            self._costs[entry.table, entry.row] = row.cells[scene]["seconds"]

    def _targets(self, world: str, folder: Path) -> tuple[int, ...]:
        """Returns the target cameras of a scene: those that the first model's training excluded from inputs."""
        with warnings.catch_warnings(action="ignore", category=FitWarning):
            return default_views(self._first[world], self._first[world].open_scene(folder))[1]

    def train(self, world: str, base: TrainConfig) -> Restored | None:
        """Trains the ablations of a world; returns the model of the first one, the base run, if it is finished."""
        rows, folder = list(load_ablations()[1].values()), self.out / "runs" / world
        study, reason = None, ""
        try:
            study = self._study(base, rows, world)
        except InputError as error:
            reason = str(error)
        for ablation in rows:
            row = self._row(TRAINED, f"{ablation.name}: {ablation.differs}", world, "", {world: ablation.paper})
            row.seed = base.seed
            if study is None:
                row.missing["run"] = reason
                continue
            asked = {"run": to_dict(study.configs[ablation.name]), "scenes": [scene.name for scene in study.train]}
            place = folder / study.same_as(ablation.name)
            run = partial(_trained, study, place, self._end)
            self._measure(row, "run", asked, run, NO_TIME if time.monotonic() > self._end else None)
        first = self.rows[TRAINED, f"{rows[0].name}: {rows[0].differs}", world]
        return restore(folder / rows[0].name / "seed_0", self.job.device) if first.cells else None

    def _row(self, table: str, label: str, world: str, model: str, paper: Mapping[str, str]) -> Row:
        return self.rows.setdefault((table, label, world), Row(table, label, world, model, paper.get(world, "")))

    def _measure(self, row: Row, scene: str, asked: dict, run: Callable[[], dict], reason: str | None) -> None:
        """Reads the cell of a row and scene, or measures it if there is no ``reason`` against it."""
        machine = self._machine if row.table == SPEED else {"device": self.job.device}
        name, asked = (row.table, row.world, row.label, scene), {**self._code, **machine, **asked}
        cell, before = self._cells.read(name, asked)
        if before is not None:
            row.before[scene] = before
        if cell is None and reason is None:
            start = time.monotonic()
            try:
                with warnings.catch_warnings():
                    result = run()
            except (InputError, NumericalError, CaptureError, torch.OutOfMemoryError) as error:
                reason = str(error).partition("\n")[0] or type(error).__name__
            else:
                cell = {"asked": asked, "seconds": time.monotonic() - start, "device": self._machine["device"],
                        "result": result, **result.pop("cost", {})}  # fmt: skip
                self._cells.write(name, cell)
                self.say(f"{row.table}, {row.world}: {row.label}, {scene}: {cell['seconds']:.1f} s")
        if cell is None:
            row.missing[scene] = reason
        else:
            row.cells[scene] = cell

    def _root(self, name: str) -> Path:
        """Folder of a set."""
        return (self.out / "data" if self.job.data is None else Path(self.job.data)) / name

    def _count(self, world: str) -> int:
        """Number of scenes of a world."""
        return min(self.job.trajectories, math.inf if self.job.data is None else len(find_scenes(self._root(world))))

    def _scene(self, world: str, number: int) -> Path | None:
        """Returns a scene of a world, generated if needed; None if there is no time to."""
        root, count = self._root(world), self._count(world)
        if self.job.data is not None:
            folders = find_scenes(root)
            return folders[number * len(folders) // count]
        options = {"seed": SEED, "n_trajectories": count}
        folder = scene_folder(root, *build_world(world, "published", options).scenes()[number])
        if time.monotonic() > self._end and not folder.is_dir():
            return None
        generate(root, world, preset="published", part=(number + 1, count), progress=False, **options)
        return folder

    def _study(self, base: TrainConfig, rows: Sequence[Ablation], world: str) -> Study:
        """Returns the ablations of a world. Raises InputError if they do not fit its training set, or it has none."""
        root = self._root(f"{world}{TRAINING}")
        if self.job.data is not None:
            return Study(base, rows, find_scenes(root), device=self.job.device)
        if time.monotonic() > self._end and not (root / "manifest.json").is_file():
            raise InputError(NO_TIME)
        return Study(base, rows, generate(root, world, preset="mini", progress=False).folders, device=self.job.device)


def _trained(study: Study, place: Path, end: float) -> dict:
    """Trains and scores one ablation. Raises InputError if it is not finished in time."""
    found = study.train_and_score(place.name, 0, place / "seed_0", end, False)
    if "by_scene" not in found:
        raise InputError(found.get("failure") or f"{found['trained']} of {found['of']} optimizer steps")
    metric = next(iter(found["by_scene"]))
    numbers = {f"future.{m}": found[m] for m in ("psnr_masked", "psnr_body", "psnr") if found.get(m) is not None}
    seconds = found["step_seconds"] * study.configs[place.name].n_steps
    by_scene = {str(number): value for number, value in enumerate(found["by_scene"][metric])}
    return {"numbers": numbers, "by_scene": by_scene, "cost": {"seconds": seconds}}
