"""Ablation studies: a base training run and rows that each change one setting, trained and scored under equal terms.

A YAML file declares base runs and rows; gsim3d/evaluate/ablations.yaml contains those of the paper.
"""

import dataclasses
import itertools
import math
import os
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from pathlib import Path

import torch

import gsim3d
from gsim3d.data import Scene, split_scenes
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import CaptureError, InputError, NumericalError, did_you_mean, naming
from gsim3d.evaluate.compare import paired
from gsim3d.evaluate.protocol import horizon, score_scene
from gsim3d.evaluate.report import summarize, write_json
from gsim3d.io.files import MAX_TEXT, read_file, read_yaml, write_whole
from gsim3d.io.plain import parse_json
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.train.config import TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import model_config, restore
from gsim3d.train.samples import check_scenes, context_cameras, spread_views

PAPER = Path(__file__).with_name("ablations.yaml")
PRESET = "tiny"  # default base run
METRICS = {"psnr_masked": "PSNR masked", "psnr": "PSNR", "psnr_body": "PSNR body"}
METHODS = ("", "constant.", "copy.")
TIE = 2.0  # standard errors within which a difference is a tie
EXPLAINED = """\
PSNR in dB, mean ± standard deviation over seeds. Baselines in brackets: the row's own last encoded particles held still
(constant) and the last input image (copy). Masked: foreground; body: movable bodies. A difference is the mean over
scenes and runs with equal seeds ± its standard error, over scenes or over seeds, whichever is larger; within 2 standard
errors it is a tie. The paper's numbers are for its own data and budget: compare differences."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of the table."""

    name: str  #: name of the row and of the folder of its runs
    differs: str  #: description of the difference from the base run
    paper: str = ""  #: published PSNR in dB; "" if there is none
    change: dict = dataclasses.field(default_factory=dict)  #: settings that replace those of the base run


def load_ablations(path: Path = PAPER) -> tuple[dict[str, TrainConfig], dict[str, Row]]:
    """Reads (base runs by preset, rows by name) from an ablation file; raises InputError if it is invalid."""
    if not path.is_file():
        raise InputError(f"{path}: does not exist; --table takes a file like {PAPER}")
    content = read_yaml(path)
    if not isinstance(content.get("bases"), dict) or not isinstance(content.get("rows"), list):
        raise InputError(f"{path}: must contain bases and rows")
    rows = [from_dict(Row, row, f"{path}: rows[{n}]: ") for n, row in enumerate(content["rows"])]
    bases = {name: from_dict(TrainConfig, base, f"{path}: {name}") for name, base in content["bases"].items()}
    return bases, {row.name: row for row in rows}


def rows_named(names: str, rows: dict[str, Row]) -> list[Row]:
    """Returns the rows of a comma-separated list of names. Raises InputError if a name is unknown or repeated."""
    found = [name.strip() for name in names.split(",")]
    if unknown := [name for name in found if name not in rows]:
        hint = did_you_mean(unknown[0], rows)
        raise InputError(f"--rows: {unknown[0]!r} does not exist; rows: {', '.join(rows)}{hint}")
    if len(set(found)) < len(found):
        raise InputError(f"--rows: {names!r} repeats a row")
    return [rows[name] for name in found]


def changed(base: TrainConfig, change: dict) -> TrainConfig:
    """Applies a row's change to a base run; raises InputError if the result is not a valid configuration."""
    before = {**to_dict(base), "model": to_dict(model_config(base))}
    before["effects"] = EffectsSpec.from_dict(base.effects).to_dict()
    return from_dict(TrainConfig, _changed(before, change, before["model"]))


def _changed(before: dict, change: dict, model: dict) -> dict:
    """Applies ``change`` to ``before``; a mapping may derive a value from the base's (rules: see paper.yaml)."""
    result = dict(before)
    for name, wanted in change.items():
        value = before.get(name)
        if not isinstance(wanted, dict):
            result[name] = wanted
        elif isinstance(value, list):  # phases; changes apply to those that simulate
            result[name] = [_changed(phase, wanted, model) if phase["horizon"] else phase for phase in value]
        elif value is None or isinstance(value, dict):
            result[name] = _changed(value or {}, wanted, model)
        else:
            ((rule, operand),) = wanted.items()
            result[name] = {
                "times": lambda: type(value)(operand * value),
                "at_most": lambda: min(operand, value),
                "at_least": lambda: max(operand, value),
                "same_as": lambda: model[operand.split(".")[0]][operand.split(".")[1]],
            }[rule]()
    return result


def base_run(
    bases: dict[str, TrainConfig],
    preset: str | None = None,
    config: str | Path | None = None,
    n_steps: int | None = None,
) -> TrainConfig:
    """Returns the base run of a preset or of a ``gsim3d train`` configuration file, in ``n_steps`` optimizer steps.
    Raises InputError if the preset is unknown, or both ``preset`` and ``config`` are given."""
    if preset is not None and config is not None:
        raise InputError("--preset: cannot be combined with --config, which also defines the base run")
    preset = preset or PRESET
    if config is None and preset not in bases:
        hint = did_you_mean(preset, bases)
        raise InputError(f"--preset: must be one of {', '.join(bases)}; got {preset!r}{hint}")
    base = bases[preset] if config is None else from_dict(TrainConfig, read_yaml(config), f"{config}: ")
    return base if n_steps is None else with_steps(base, n_steps)


def with_steps(config: TrainConfig, n_steps: int) -> TrainConfig:
    """Rescales the phases of a run to ``n_steps`` optimizer steps in total; raises InputError if they are too few."""
    if n_steps < len(config.phases):
        raise InputError(f"--steps: must be at least {len(config.phases)}, one for each phase; got {n_steps}")
    counts = [max(1, n_steps * phase.steps // config.n_steps) for phase in config.phases]
    counts[counts.index(max(counts))] += n_steps - sum(counts)
    phases = [dataclasses.replace(phase, steps=count) for phase, count in zip(config.phases, counts, strict=True)]
    return dataclasses.replace(config, phases=tuple(phases))


class Study:
    """Rows of one base run on one data set.

    Args:
        base: base run.
        rows: rows to train; all are compared with the first one.
        folders: scene folders. The scenes that ``gsim3d train`` holds out are scored, for all rows over the same steps
            and from the same cameras: those that are not an input of any row, if there are any.
        n_seeds: runs per row, with different seeds.
        device: "cpu" or "cuda".

    Raises:
        InputError: a row does not fit the data or the base run; raised before training starts.
    """

    def __init__(
        self, base: TrainConfig, rows: Sequence[Row], folders: Sequence[Path], *, n_seeds: int = 1, device: str = "cpu"
    ):
        if len(folders) < 2:
            raise InputError(f"{folders[0]}: a single scene; at least two are needed, because one is held out")
        self.base, self.rows, self.n_seeds, self.device = base, list(rows), n_seeds, device
        self.train, self.test = (self._scenes(part) for part in split_scenes(folders))
        self.configs = {row.name: self._config(row) for row in rows}
        self.n_given = max(config.data.history for config in self.configs.values())
        self.n_future = min(horizon(scene, self.n_given, None) for scene in self.test)
        self.targets = []
        for scene in self.test:
            inputs = {cam for config in self.configs.values() for cam in inputs_of(scene, config)}
            others = sorted(set(range(scene.n_cams)) - inputs) or list(range(scene.n_cams))
            self.targets.append(list(base.data.target_only_cameras) or others)

    def __getstate__(self) -> dict:  # scenes are reopened in the receiving process
        return {**self.__dict__, **{part: [s.path for s in getattr(self, part)] for part in ("train", "test")}}

    def __setstate__(self, state: dict) -> None:
        self.__dict__ = state
        self.train, self.test = (self._scenes(part) for part in (self.train, self.test))

    def _scenes(self, folders: Sequence[Path]) -> list[Scene]:
        return [Scene.open(folder, fitting=self.base.data.fitting) for folder in folders]

    def _config(self, row: Row) -> TrainConfig:
        with naming(f"row {row.name}"):
            config = changed(self.base, row.change)
            check_scenes(self.test, config.data, ())
            Trainer(config, self.train, os.devnull)  # validates the remaining settings; writes nothing
        return config

    def same_as(self, name: str) -> str:
        """Returns the name of the first row with the same configuration as row ``name``; may be ``name`` itself."""
        return next(other for other, config in self.configs.items() if config == self.configs[name])

    def run(
        self,
        out: Path,
        command: str,
        *,
        together: int = 1,
        minutes: float = math.inf,
        progress: bool = True,
        say: Callable[[str], None] = print,
    ) -> dict:
        """Trains and scores all runs that are not finished yet; returns the content of ablation.json.

        Args:
            out: folder of the runs, ablation.json and ablation.md; the tables are rewritten after every run.
            command: command line to record in the tables.
            together: number of runs in parallel, each in its own process.
            minutes: time limit for training; the next call resumes.
            progress: show progress bars.
            say: called with a line for each finished run.
        """
        end = time.monotonic() + 60 * minutes
        out.mkdir(parents=True, exist_ok=True)
        names = list(dict.fromkeys(self.same_as(row.name) for row in self.rows))
        jobs = [(name, seed) for seed in range(self.n_seeds) for name in names]
        arguments = [
            (self, name, seed, out / name / f"seed_{seed}", end, progress and together == 1) for name, seed in jobs
        ]
        results: dict[str, list[dict]] = {name: [] for name in names}
        for done, (number, result) in enumerate(_results(arguments, together), 1):
            name, seed = jobs[number]
            results[name].append({"seed": seed, **result})
            results[name].sort(key=lambda run: run["seed"])
            say(f"[{done}/{len(jobs)}] {name}, seed {seed}: {outcome(result)}")
            content = as_dict(self, results, command)
            write_json(out / "ablation.json", content)
            write_whole(out / "ablation.md", markdown(content))
        return content

    def train_and_score(self, name: str, seed: int, folder: Path, end: float, progress: bool) -> dict:
        """Trains and scores one run; returns its scores, or its progress at time ``end``, or its failure."""
        config = dataclasses.replace(self.configs[name], seed=self.configs[name].seed + seed)
        known, asked = _read(folder / "score.json"), {
            "train": to_dict(config),
            "scenes": [[scene.name for scene in part] for part in (self.train, self.test)],
            "steps": [self.n_given, self.n_future],
            "cameras": self.targets,
        }  # fmt: skip
        if all(known.get(key) == value for key, value in asked.items()):
            return known["result"]
        try:
            trainer = Trainer(config, self.train, folder, device=self.device)
            if not trainer.same_scenes:
                raise InputError(f"{folder}: was trained on fewer scenes than given now; use another folder")
            if time.monotonic() < end:
                trainer.run(end=end, progress=progress)
            if trainer.step < config.n_steps:
                return {"trained": trainer.step, "of": config.n_steps}
            result = self._score(folder, config)
        except (NumericalError, CaptureError) as error:
            return {"failure": str(error)}
        except torch.OutOfMemoryError:
            return {"failure": "out of memory"}
        result["step_seconds"] = trainer.seconds / trainer.step
        write_json(folder / "score.json", {**asked, "device": self.device, "result": result})
        return result

    def _score(self, folder: Path, config: TrainConfig) -> dict:
        restored, start = restore(folder, self.device), self.n_given - config.data.history
        scores = []
        for scene, cams in zip(self.test, self.targets, strict=True):
            cameras = {"context_cams": inputs_of(scene, config), "target_cams": cams}
            options = {"start": start, "n_future": self.n_future, "metrics": tuple(METRICS)}
            scores.append(score_scene(restored, scene, **cameras, **options))
        means = summarize(scores)
        result = {f"{m}{metric}": means.get(f"{m}future.{metric}") for metric in METRICS for m in METHODS}
        known = [metric for metric in METRICS if result[metric] is not None]
        alone = [summarize([score]) for score in scores]
        return {**result, "by_scene": {metric: [of[f"future.{metric}"] for of in alone] for metric in known}}


def inputs_of(scene: Scene, config: TrainConfig) -> list[int]:
    """Returns the input cameras of a model trained by this run."""
    return spread_views(context_cameras(scene, config.data), config.data.context_views, 0)


def _read(file: Path) -> dict:
    """Reads the stored result of a finished run; returns {} if missing or invalid, so that it is computed again."""
    try:
        known = parse_json(read_file(file, MAX_TEXT)) if file.is_file() else {}
        return known if "by_scene" in known["result"] else {}
    except (ValueError, KeyError, TypeError):
        return {}


def _results(jobs: Sequence[tuple], together: int) -> Iterator[tuple[int, dict]]:
    """Yields (index of a job, its result) in order of completion."""
    if together < 2:
        yield from ((number, Study.train_and_score(*job)) for number, job in enumerate(jobs))
        return
    threads = max(1, len(os.sched_getaffinity(0)) // together)
    with ProcessPoolExecutor(together, get_context("spawn"), _begin, (threads,)) as pool:
        futures = {pool.submit(Study.train_and_score, *job): number for number, job in enumerate(jobs)}
        try:
            yield from ((futures[future], future.result()) for future in as_completed(futures))
        except BrokenProcessPool:
            raise InputError("a process was killed; run again with a smaller --together") from None
        finally:
            pool.shutdown(cancel_futures=True)


def _begin(n_threads: int) -> None:
    """Initialises a worker process: sets its threads and GPU, and makes it exit when its parent dies."""
    torch.set_num_threads(n_threads)
    if torch.cuda.is_available():
        torch.cuda.set_device(os.getpid() % torch.cuda.device_count())
    parent = parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def as_dict(study: Study, results: dict[str, list[dict]], command: str) -> dict:
    """Builds the content of ablation.json: for each row its runs, means, and differences from the first row."""
    rows = []
    for row in study.rows:
        same = study.same_as(row.name)
        entry: dict = {"row": row.name, "differs": row.differs, "paper": row.paper or None}
        entry |= {"same_as": same} if same != row.name else {}
        runs = scored(results.get(same, []))
        values = [name for name in runs[0] if name not in ("seed", "by_scene")] if runs else []
        means = {v: statistics.fmean(run[v] for run in runs) for v in values if all(run[v] is not None for run in runs)}
        rows.append({**entry, "runs": results.get(same, []), **means})
    metric = "psnr_masked" if "psnr_masked" in rows[0] else "psnr"
    for row in rows[1:]:
        row |= paired_difference(row["runs"], rows[0]["runs"], metric)
    on_gpu = study.device == "cuda"
    device = torch.cuda.get_device_name() if on_gpu else f"CPU, {torch.get_num_threads()} threads"
    return {
        "format": 2,
        "command": command,
        "machine": {"device": device, "gsim3d": gsim3d.__version__, "torch": torch.__version__},
        "base": to_dict(study.base),
        "scenes": {"trained": len(study.train), "held_out": len(study.test)},
        "steps": {"before": study.n_given, "predicted": study.n_future},
        "seeds": study.n_seeds,
        "compared": metric,
        "rows": rows,
    }


def scored(runs: Sequence[dict]) -> list[dict]:
    """Returns the runs that finished with scores."""
    return [run for run in runs if "by_scene" in run]


def paired_difference(runs: Sequence[dict], first: Sequence[dict], metric: str) -> dict:
    """Returns ``difference``, ``standard_error`` and ``tie`` of the runs of two rows, paired by seed and scene.

    Scores of one seed share weights, and scores of one scene share data, so pairs are not independent: the standard
    error is the larger of those over seed means and over scene means. It is None for a single pair; {} without pairs.
    """
    ours, theirs = ({r["seed"]: r["by_scene"][metric] for r in scored(part)} for part in (runs, first))
    pairs = [[a - b for a, b in zip(ours[seed], theirs[seed], strict=True)] for seed in ours if seed in theirs]
    if not pairs:
        return {}
    difference = statistics.fmean(itertools.chain(*pairs))
    means = [[statistics.fmean(part) for part in parts] for parts in (pairs, list(zip(*pairs)))]
    error = max((error for part in means if (error := paired(part)[1]) is not None), default=None)
    tie = None if error is None else abs(difference) <= TIE * error
    return {"difference": difference, "standard_error": error, "tie": tie}


def outcome(run: dict) -> str:
    """Returns a short description of a run's result."""
    if "failure" in run:
        return f"failed: {run['failure']}"
    if "trained" in run:
        return f"{run['trained']} of {run['of']} optimizer steps; run again to resume"
    return ", ".join(f"{label} {run[metric]:.2f}" for metric, label in METRICS.items() if run[metric] is not None)


def markdown(content: dict) -> str:
    """Returns ablation.md: the table and its explanation."""
    rows, base, scenes, steps = (content[name] for name in ("rows", "base", "scenes", "steps"))
    head = ["row", "difference from base", *(f"{label} (constant, copy)" for label in METRICS.values())]
    table = [[*head, f"against {rows[0]['row']}", "s per step", "paper"]]
    table.append(["---"] * len(table[0]))
    for row in rows:
        seconds = f"{row['step_seconds']:.3g}" if "step_seconds" in row else "-"
        values = [_values(row, metric) for metric in METRICS]
        table.append([row["row"], row["differs"], *values, _against(row), seconds, row["paper"] or "-"])
    lines = ["| " + " | ".join(cells) + " |" for cells in table]
    n_steps, device = sum(phase["steps"] for phase in base["phases"]), content["machine"]["device"]
    lines += [
        "",
        f"Base run: preset {base['preset']}, {n_steps} optimizer steps. {scenes['trained']} training scenes, "
        f"{scenes['held_out']} held-out scenes scored: {steps['predicted']} steps predicted after {steps['before']}. "
        f"Seeds: {content['seeds']}. {device}.",
        "",
        EXPLAINED,
        "",
        f"Made by `{content['command']}`",
    ]
    for row in rows:
        for run in row["runs"]:
            if "by_scene" not in run and "same_as" not in row:
                lines += ["", f"{row['row']}, seed {run['seed']}: {outcome(run)}"]
    return "\n".join(lines) + "\n"


def _values(row: dict, metric: str) -> str:
    ours, constant, copy = ("-" if (v := row.get(f"{m}{metric}")) is None else f"{v:.2f}" for m in METHODS)
    seeds = [run[metric] for run in scored(row["runs"]) if run[metric] is not None]
    return f"{ours}{f' ± {statistics.stdev(seeds):.2f}' if len(seeds) > 1 else ''} ({constant}, {copy})"


def _against(row: dict) -> str:
    if "same_as" in row:
        return f"same as {row['same_as']}"
    if "difference" not in row:
        return "failed" if any("failure" in run for run in row["runs"]) else "-"
    error = "" if row["standard_error"] is None else f" ± {row['standard_error']:.2f}"
    difference = f"{round(row['difference'], 2) + 0.0:+.2f}{error}"
    return f"tie ({difference})" if row["tie"] else difference
