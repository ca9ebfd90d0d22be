"""`gsim3d bound`: what a perfect simulator scores that sees the start of a scene as well as images show it.

The scenes of a generated set are simulated again with small errors in how bodies start, rendered exactly, and compared
with the truth. Imports no torch.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.files import MAX_TEXT, opencv_path, read_file, whole_file, write_whole
from gsim3d.io.plain import parse_json
from gsim3d.io.terminal import in_columns
from gsim3d.synth import writer
from gsim3d.synth.render import BACKGROUND, BODY
from gsim3d.synth.run import NEEDED, check_processes, each, require_engine, require_packages
from gsim3d.synth.scene_setup import SoftBody, Unstable
from gsim3d.synth.world import Actor, World
from gsim3d.synth.worlds import WORLDS

GIVEN = 4  # steps that a model is given; the errors are those of the last one
SAMPLES = 4  # simulations of each scene
MAX_ATTEMPTS = 8  # errors that are drawn for one sample before its scene is given up
PSNR_CAP = 100.0  # dB, as of gsim3d.evaluate.metrics
METRICS = ("psnr_masked", "psnr_body")


@dataclass(frozen=True)
class StartErrors:
    """Lengths of the errors of each body at the last given step; directions are random.

    Attributes:
        velocity: m/step.
        place: metres; the name is part of stored results.
        angle: radians.
        spin: share of the body's spin.
    """

    velocity: float
    place: float = 0.0
    angle: float = 0.0
    spin: float = 0.0


_SOFT = StartErrors(velocity=0.42e-3, place=2e-3, angle=10e-3)
ERRORS = {"elastic": _SOFT, "cloth": _SOFT, "rigid": StartErrors(velocity=1e-3, spin=0.03)}


def bound(
    folder: str | Path,
    *,
    given: dict[str, float] | None = None,
    trajectories: int | None = None,
    processes: int | None = None,
    out: str | Path | None = None,
    progress: bool = True,
) -> dict:
    """Scores of simulations of the scenes in ``folder`` whose bodies start with the errors of ERRORS.

    Args:
        folder: a set that `gsim3d generate` made, with its manifest.
        given: metric ("psnr_masked", "psnr_body") -> PSNR of a model's given steps, dB, whose squared error is added.
        trajectories: the first so many of the set; None: all.
        processes: None: as many as there are cores.
        out: folder for bound.json and the squared errors of each scene, which are not computed again; None: nothing
            is written.
        progress: show a progress bar.

    Returns:
        What bound.json holds. Of "one" (one simulation) and "mean" (the mean image of four), with "_given" where the
        model's error is added: metric -> [mean over scenes of the mean over steps and cameras, its standard error];
        "objects": the same by object; "scenes": the values of each scene.

    Raises:
        InputError: sets of another origin or version, and missing packages.
    """
    folder, out = Path(folder), None if out is None else Path(out)
    check_processes(processes)
    if trajectories is not None and trajectories < 1:
        raise InputError(f"trajectories must be 1 or more; got {trajectories}")
    world = read_world(folder)
    require_packages(NEEDED)
    require_engine(world.engine)
    if world.n_frames <= GIVEN:
        raise InputError(f"{folder}: {world.n_frames} frames; more than the {GIVEN} given ones are needed")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    chosen = world.scenes()[:trajectories]
    jobs = [(world, scene, writer.scene_folder(folder, *scene), out) for scene in chosen]
    found = dict(each(_scene_errors, jobs, processes, "scenes" if progress else None))
    summary = {
        "set": str(folder),
        "world": world.name,
        "errors": dataclasses.asdict(ERRORS[world.name]),
        "samples": SAMPLES,
        "given": given,
        "n_scenes": len(chosen),
        "n_future_steps": world.n_frames - GIVEN,
        **_summary({scene: found[scene] for scene in chosen}, given or {}),
    }
    if out is not None:
        write_whole(out / "bound.json", json.dumps(summary, indent=1) + "\n")
    return summary


def read_world(folder: Path) -> World:
    """The settings of the set in ``folder``, from its manifest. Raises InputError where there is none that is read."""
    file = folder / "manifest.json"
    try:
        settings = parse_json(file.read_bytes())["settings"]
        settings = {key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()}
        world = WORLDS[settings.pop("world")](**settings)
    except FileNotFoundError:
        raise InputError(f"{file} does not exist: name a finished set that gsim3d generate made") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file} is not of a set that this version can make again: {error}") from error
    world.check()
    return world


def _scene_errors(world: World, scene: tuple[str, int], folder: Path, out: Path | None):
    """(scene, squared errors float32 [samples + 1, steps, cameras, metrics]): of single samples, and their mean image.

    NaN where a mask is empty.
    """
    if not writer.is_finished(folder, world.fingerprint(scene[0])):
        raise InputError(f"{folder} is not finished: run gsim3d generate again")
    key = json.dumps([world.fingerprint(scene[0]), dataclasses.asdict(ERRORS[world.name]), GIVEN, SAMPLES])
    key = hashlib.sha256(key.encode()).hexdigest()
    file = None if out is None else out / f"{scene[0]}-{scene[1]:04d}.npz"
    if file is not None and file.is_file():
        with np.load(file) as known:
            if str(known["key"]) != key:
                raise InputError(f"{file} is of another set; choose another folder or remove it")
            return scene, known["errors"]
    attempt = writer.read_metadata(folder)["attempt"]
    true, masks = _truth(world, folder)
    total, errors = np.zeros(true.shape, np.float32), []
    for sample in range(SAMPLES):
        images = _simulated(world, scene, attempt, sample)
        errors.append(_squared_error(images, true, masks))
        total += images
    errors.append(_squared_error(total / SAMPLES, true, masks))
    errors = np.stack(errors).astype(np.float32)
    if file is not None:
        with whole_file(file) as part:
            np.savez(part, key=key, errors=errors)
    return scene, errors


def _truth(world: World, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Colours uint8 [T, V, H, W, 3] and masks bool [2, T, V, H, W] of the steps after the given ones."""
    import cv2

    def read(kind: str, flag: int) -> np.ndarray:
        steps = []
        for step in range(GIVEN, world.n_frames):
            images = []
            for cam in range(world.n_cams):
                name = writer.FILE_TEMPLATE.format(cam_ix=cam, img_type=kind, n_step=step)
                image = cv2.imread(opencv_path(folder / f"{name}.png"), flag)
                if image is None or image.shape[:2] != (world.image_size, world.image_size):
                    raise InputError(f"{folder / name}.png cannot be read as an image of {world.image_size} pixels")
                images.append(image)
            steps.append(images)
        return np.array(steps)

    labels = read("seg", cv2.IMREAD_GRAYSCALE)
    return read("rgb", cv2.IMREAD_COLOR)[..., ::-1], np.stack([labels != BACKGROUND, labels == BODY])


def _simulated(world: World, scene: tuple[str, int], attempt: int, sample: int) -> np.ndarray:
    """Images uint8 [T, V, H, W, 3] of the steps after the given ones."""
    drawn, rig = world.draw(*scene, attempt), world.rig(scene)
    errors = ERRORS[world.name]
    name = zlib.crc32(scene[0].encode())
    for redrawn in range(MAX_ATTEMPTS):
        rng = np.random.default_rng([world.seed, name, scene[1], sample, redrawn, zlib.crc32(b"bound")])
        actors = [_with_errors(actor, errors, world.fps, rng) for actor in drawn.actors]
        try:
            _, moved = world.simulate(dataclasses.replace(drawn, actors=actors))
        except Unstable:
            continue
        renderer = world.renderer(rig, drawn)
        return np.stack([renderer.draw(vertices).rgb for vertices in list(zip(*moved))[GIVEN:]])
    raise InputError(f"{scene[0]}/{scene[1]:04d}: none of {MAX_ATTEMPTS} simulations with errors could be used")


def _with_errors(actor: Actor, errors: StartErrors, fps: float, rng: np.random.Generator) -> Actor:
    """``actor`` at time 0, with errors whose lengths at the last given step are ``errors``.

    Bodies are in free flight until then: the start makes up for what the errors of velocity and spin add by that step.
    """
    body, before = actor.body, GIVEN - 1
    velocity = errors.velocity * _direction(rng)
    spin = errors.spin * np.linalg.norm(body.spin) * _direction(rng)
    shift = errors.place * _direction(rng) - before * velocity
    turn = _rotation(errors.angle * _direction(rng) - before / fps * spin)
    centre = (actor.vertices.min(0) + actor.vertices.max(0)) / 2

    def moved(points: np.ndarray) -> np.ndarray:
        return ((points - centre)[:, None] * turn).sum(-1) + centre + shift

    if isinstance(body, SoftBody):
        moved_body = {"vertices": moved(body.vertices)}
    else:
        moved_body = {"parts": tuple(moved(part) for part in body.parts)}
    body = dataclasses.replace(body, **moved_body, velocity=body.velocity + velocity * fps, spin=body.spin + spin)
    return dataclasses.replace(actor, body=body, vertices=moved(actor.vertices))


def _direction(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Matrix [3, 3] that turns about ``vector`` by its length, radians."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle if angle else vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _squared_error(images: np.ndarray, true: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Mean squared errors [T, V, 2] over each mask and the channels, of colours from 0 to 1."""
    error = np.square((images.astype(np.float32) - true) / 255).mean(-1)
    count = masks.sum((-2, -1))
    total = np.where(masks, error, 0).sum((-2, -1), dtype=np.float64)
    return np.moveaxis(total / np.where(count, count, np.nan), 0, -1)


def _summary(scenes: dict[tuple[str, int], np.ndarray], given: dict[str, float]) -> dict:
    """Means and standard errors of all scenes and of those of each object, and the value of each scene."""
    table: dict[str, dict[str, np.ndarray]] = {}  # "one", "mean_given" ... -> metric -> values of the scenes
    for kind, samples in (("one", slice(0, SAMPLES)), ("mean", slice(SAMPLES, None))):
        for column, metric in enumerate(METRICS):
            errors = [some[samples, ..., column] for some in scenes.values()]
            added = {kind: 0.0}
            if metric in given:
                added[f"{kind}_given"] = 10 ** (-given[metric] / 10)
            for name, more in added.items():
                table.setdefault(name, {})[metric] = np.array([_mean_psnr(error + more) for error in errors])

    def means(of: np.ndarray) -> dict:
        return {
            kind: {m: _mean_and_error(values[of]) for m, values in metrics.items()} for kind, metrics in table.items()
        }

    names = np.array([name for name, _ in scenes])
    by_scene = {
        f"{name}/{sample:04d}": {
            kind: {m: float(v[index]) for m, v in metrics.items()} for kind, metrics in table.items()
        }
        for index, (name, sample) in enumerate(scenes)
    }
    by_object = {str(name): means(names == name) for name in dict.fromkeys(names)}
    return {**means(np.ones(len(names), bool)), "objects": by_object, "scenes": by_scene}


def _mean_psnr(errors: np.ndarray) -> float:
    """Mean PSNR over samples, steps and cameras of squared errors; NaN are left out."""
    return float(np.nanmean(-10 * np.log10(np.maximum(errors.astype(np.float64), 10 ** (-PSNR_CAP / 10)))))


def _mean_and_error(values: np.ndarray) -> list[float | None]:
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return [float(values.mean()), error]


def read_given(text: str) -> dict[str, float]:
    """Metric -> PSNR of given steps in dB, from a number or from a file that `gsim3d evaluate` wrote.

    Raises:
        InputError: ``text`` is neither.
    """
    try:
        given = {"psnr_masked": float(text)}
    except ValueError:
        try:
            scores = parse_json(read_file(text, MAX_TEXT))
            given = {metric: scores.get(f"past.{metric}") for metric in ("psnr_masked", "psnr_body")}
            given = {metric: float(value) for metric, value in given.items() if value is not None}
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"--given: {text} is neither a number nor a file of scores ({error})") from None
    if "psnr_masked" not in given:
        raise InputError(f"--given: {text} has no past.psnr_masked: name metrics.json of gsim3d evaluate")
    for metric, value in given.items():
        if not math.isfinite(value):
            raise InputError(f"--given: {metric} must be finite; got {value}")
    return given


def table(summary: dict) -> str:
    """A table of the bounds by object and of all scenes, in dB with standard errors."""
    kinds = [
        (f"{part}{label}{more}", f"{kind}{suffix}", metric)
        for metric, part in (("psnr_masked", ""), ("psnr_body", "bodies: "))
        for suffix, more in (("", ""), ("_given", " + given"))
        for kind, label in (("one", "one"), ("mean", f"mean of {summary['samples']}"))
        if metric in summary.get(f"{kind}{suffix}", {})
    ]
    rows = [("", *(label for label, _, _ in kinds))]
    for name, values in [*summary["objects"].items(), ("all", summary)]:
        cells = []
        for _, kind, metric in kinds:
            mean, error = values[kind][metric]
            cells.append(f"{mean:.2f}" + ("" if error is None else f" +- {error:.2f}"))
        rows.append((name, *cells))
    given = "".join(f", {metric} of given steps {value:.2f}" for metric, value in (summary["given"] or {}).items())
    head = f"{summary['world']}, {summary['n_scenes']} scenes, {summary['n_future_steps']} steps, dB{given}"
    return f"{head}\n{in_columns(rows)}"
