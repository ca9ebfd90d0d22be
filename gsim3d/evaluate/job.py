"""Implementation of ``gsim3d evaluate``: scores a checkpoint and predictions of other models, and writes a report."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from gsim3d.baselines import baseline
from gsim3d.data import Scene, find_scenes, published_split, split_scenes
from gsim3d.errors import InputError, NumericalError
from gsim3d.evaluate import compare, trust
from gsim3d.evaluate.physics import true_states
from gsim3d.evaluate.pictures import write_curves
from gsim3d.evaluate.predictions import Predictions
from gsim3d.evaluate.protocol import check_cameras, default_views, horizon, score_scenes
from gsim3d.evaluate.report import markdown, summarize, table, write_csv, write_json
from gsim3d.evaluate.scoring import SceneScores, measurable
from gsim3d.io.files import new_output_path, output_path, with_parents, write_whole
from gsim3d.numerics.trust import trust_of
from gsim3d.pretrained import FOLDER, folder_of
from gsim3d.synth.held_out import set_of
from gsim3d.train.processes import Processes, joined
from gsim3d.train.restore import Restored, restore

Views = list[tuple[Sequence[int] | None, Sequence[int]]]  # (input cameras, target cameras) of each scene


@dataclass(frozen=True)
class Job:
    """The options of ``gsim3d evaluate``."""

    data: str  #: folder with scenes, or a report to compare
    checkpoint: str | None = None  #: see :func:`gsim3d.train.restore.restore`; None scores only ``predictions``
    predictions: Sequence[str] = ()  #: "[NAME=]DIR" of other models
    baselines: Sequence[str] = ()  #: names of :data:`gsim3d.baselines.BASELINES`, fitted to each scene
    given: int | None = None  #: number of input steps of the other models, if there is no checkpoint
    scenes: str | None = None  #: "test", "train" or "all"; None means "all" for held-out data sets, else "test"
    split: str = "gsim3d"  #: "gsim3d" or "published", the rule that holds scenes out
    steps: int | None = None  #: number of steps to predict; None predicts to the end of the shortest video
    cameras: Sequence[int] | None = None  #: target cameras; None uses those excluded from the training's inputs
    context: Sequence[int] | None = None  #: input cameras; None spaces them evenly
    metrics: Sequence[str] | None = None  #: metrics to measure; None measures all whose weights are installed
    clips: int = 48  #: largest number of clips for FVD
    trust: bool = False  #: also report how well the calibrated bounds of errors hold
    calibrate_trust: bool = False  #: calibrate the bounds and write them beside the checkpoint, instead of scoring
    keep: Sequence[str] = ()  #: see :meth:`gsim3d.train.restore.Restored.open_scene`
    resample: bool = False  #: see :meth:`gsim3d.train.restore.Restored.open_scene`
    against: str | None = None  #: report of another model to compare with
    device: str = "cpu"  #: "cpu" or "cuda"
    out: str | None = None  #: JSON file; None writes metrics.json next to the checkpoint or predictions


def evaluate(job: Job) -> None:
    """Runs ``job``; prints tables and writes the report. Raises InputError if options contradict each other, or the
    data do not fit."""
    other = None if job.against is None else compare.read_report(job.against)
    if other is not None and job.checkpoint is None and not (job.predictions or job.baselines):
        comparison = compare.compare(compare.read_report(job.data), other, job.against)
        print(compare.table(comparison, job.against))
        return
    metrics, not_measured = measurable(job.metrics)
    if job.checkpoint is None and not (job.predictions or job.baselines):
        raise InputError("nothing to evaluate: give a CHECKPOINT, --predictions of other models, or --baselines")
    if job.checkpoint is None and (job.given is None or job.given < 1):
        raise InputError("--given: the number of input steps (at least 1) is required without a CHECKPOINT")
    if job.checkpoint is not None and job.given is not None:
        raise InputError("--given: cannot be combined with a CHECKPOINT, whose history sets the input steps")
    if job.checkpoint is None and (job.resample or job.keep or job.trust or job.calibrate_trust):
        raise InputError("--resample, --keep, --trust and --calibrate-trust require a CHECKPOINT")
    if job.calibrate_trust and (job.predictions or job.baselines or job.trust or other):
        raise InputError("--calibrate-trust cannot be combined with --predictions, --baselines, --trust or --against")
    if job.context and (job.trust or job.calibrate_trust):
        raise InputError("--context cannot be combined with --trust or --calibrate-trust")
    if job.calibrate_trust and folder_of(job.checkpoint).resolve().is_relative_to(FOLDER.resolve()):
        raise InputError(f"--calibrate-trust: {job.checkpoint} is of the package; give model.safetensors of a copy")
    with joined(job.device) as processes:
        _evaluate(job, metrics, not_measured, other, processes)


def _evaluate(job: Job, metrics: tuple, not_measured: dict, against: dict | None, processes: Processes) -> None:
    """Scores this process's share of the scenes; the first process writes the report."""
    restored = None if job.checkpoint is None else restore(job.checkpoint, job.device)
    if job.trust:
        trust_of(restored.simulator, job.checkpoint)
    fitted = [baseline(name, job.device) for name in job.baselines]
    others = [*(Predictions.open(given, job.data) for given in job.predictions), *fitted]
    if len({other.name for other in others}) != len(others):
        raise InputError("--predictions, --baselines: names must be unique; use NAME=DIR")
    out = _report_path(job, others)
    n_encoded = job.given if restored is None else restored.data.history
    scenes, conditions = _open_scenes(job, restored)
    views, n_future = _views(job, restored, others, scenes, n_encoded)
    if (job.trust or job.calibrate_trust) and not any([true_states(scene) for scene in scenes]):
        raise InputError(f"{job.data}: trust needs generated scenes, with states.npz; no scene has one")
    if job.calibrate_trust:
        if processes.is_first:
            made = trust.calibrate(restored, scenes, n_future)
            print(f"written: {trust.save_trust(folder_of(job.checkpoint), restored.checkpoint.digest, made)}")
        return
    names, not_applicable = [_name(scene, job.data) for scene in scenes], {}
    applied = [[] for _ in scenes]
    for name, scene, (_, targets), own in zip(names, scenes, views, applied, strict=True):
        for other in others:
            try:
                other.check(scene, targets, n_encoded, n_future)
                own.append(other)
            except InputError as error:
                if other not in fitted:
                    raise
                not_applicable.setdefault(other.name, {})[name] = str(error)
    conditions |= {
        "checkpoint": None if restored is None else restored.checkpoint.digest,
        "effects": None if restored is None else restored.plan.spec.hash,
        "predictions": {other.name: str(other.folder) for own in applied for other in own},
        "not_applicable": not_applicable,
        "fitted": {other.name: asdict(other.config) for other in fitted},
        "data": str(job.data),
        "split": job.split,
        "fps": sorted({scene.fps for scene in scenes}),
        "cameras": {
            name: {"context": None if context is None else list(context), "target": list(targets)}
            for name, (context, targets) in zip(names, views)
        },
    }
    processes.check_agreement(**{"CHECKPOINT, DATA or options": (conditions, n_future, metrics)})
    if against is not None:
        compare.check_same({"n_encoded_steps": n_encoded, "n_future_steps": n_future}, names, against, job.against)
    given = {"n_encoded": n_encoded, "n_future": n_future, "metrics": metrics, "others": applied, "clips": job.clips}
    scores = score_scenes(restored, scenes, views, **given, processes=processes, quiet=False)
    if not processes.is_first:
        return
    scores = [replace(score, scene=name) for score, name in zip(scores, names, strict=True)]
    summary = {**conditions, **summarize(scores, not_measured)}
    print("\n".join([table(summary), *(reason for own in not_applicable.values() for reason in own.values())]))
    refused = None
    try:
        if job.trust:
            summary["trust"] = trust.report(restored.simulator.trust, trust.collect(restored, scenes, n_future))
            print(f"\n{trust.table(summary['trust'])}")
        if against is not None:
            comparison = compare.compare(summary, against, job.against)
            summary["against"] = {"file": job.against, "checkpoint": against.get("checkpoint"), **comparison[""]}
            print(f"\n{compare.table(comparison, job.against)}")
    except (InputError, NumericalError) as error:  # raised after the scores are written
        refused = error
    files = _write(out, job.data, scores, summary)
    print("\nwritten: " + ", ".join(str(path) for path in files))
    if refused is not None:
        raise refused


def _report_path(job: Job, others: list[Predictions]) -> Path:
    if job.out:
        return output_path(job.out, ".json")
    place = folder_of(job.checkpoint) if job.checkpoint else Path(others[0].folder if job.predictions else "")
    if place.is_relative_to(FOLDER):  # the installed package is not written to
        return new_output_path("metrics.json", "file")
    return place / "metrics.json"


def _open_scenes(job: Job, restored: Restored | None) -> tuple[list[Scene], dict]:
    """Opens the chosen scenes, fitted to the model; also returns the data set and split they belong to."""
    folders = find_scenes(job.data)
    found = set_of(folders)
    part = job.scenes or ("all" if found and found["name"] else "test")
    train, test = (split_scenes if job.split == "gsim3d" else published_split)(folders)
    chosen = {"all": folders, "train": train, "test": test or folders}[part]
    if restored is None:
        scenes = [Scene.open(folder) for folder in chosen]
    else:
        scenes = [restored.open_scene(folder, keep=job.keep, resample=job.resample) for folder in chosen]
    return scenes, {"set": set_of(chosen), "part": part}


def _views(
    job: Job, restored: Restored | None, others: list[Predictions], scenes: list[Scene], n_encoded: int
) -> tuple[Views, int]:
    """Returns the cameras of each scene, and the number of steps to predict."""
    views, n_future = [], job.steps
    for scene in scenes:
        context, targets = None, job.cameras
        if restored is not None:
            context, targets = default_views(restored, scene, job.context, job.cameras)
        elif not targets:
            targets = others[0].cameras(scenes[0])
        check_cameras(scene, (*targets, *(context or ())))
        views.append((context, targets))
        n_future = min(horizon(scene, n_encoded, job.steps), n_future or scene.n_steps)
    return views, n_future


def _name(scene: Scene, root: str) -> str:
    """Returns a unique name of a scene: its folder relative to the data set."""
    below = scene.path.relative_to(root).as_posix()
    return scene.name if below == "." else below


def _write(out: Path, data: str, scores: list[SceneScores], summary: dict) -> list[Path]:
    """Writes the report as JSON, CSV, markdown and PNG; returns the files."""
    with_parents(out)
    files = [out, out.with_suffix(".csv"), out.with_suffix(".md")]
    write_json(files[0], summary)
    write_csv(files[1], scores)
    write_whole(files[2], markdown(summary, Path(data).absolute().name))
    if not summary["by_step"]:
        return files
    rates, curves = summary["fps"], out.with_suffix(".png")
    try:
        write_curves(curves, summary, rates[0] if len(rates) == 1 else None)
    except InputError as error:
        print(f"no curves: {error}")
        return files
    return [*files, curves]
