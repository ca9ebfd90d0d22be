"""One run of a study: trained and scored in a folder of its own, from where it was left."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from gsim3d.ablate.table import METHODS, PSNRS
from gsim3d.data import Scene
from gsim3d.errors import CaptureError, InputError, NumericalError
from gsim3d.evaluate.protocol import score_scene
from gsim3d.evaluate.report import summarize, write_json
from gsim3d.io.files import MAX_TEXT, read_file
from gsim3d.io.plain import parse_json
from gsim3d.io.settings import to_dict
from gsim3d.train.config import TrainConfig
from gsim3d.train.log import LOG, read_entry
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore
from gsim3d.train.samples import context_cameras, spread_views
from gsim3d.train.side_by_side import last_entry

SCORE = "score.json"


@dataclass(frozen=True)
class Trial:
    """Plain values, so that another process can run it.

    train, test: folders of scenes.   targets: cameras that are scored, for each scene of ``test``.
    n_given: steps before the first scored one.   n_future: scored steps.
    """

    config: TrainConfig
    train: list[Path]
    test: list[Path]
    targets: list[list[int]]
    n_given: int
    n_future: int
    device: str

    def run(self, folder: Path, end: float, progress: bool) -> dict:
        """What it scores, or how far it is if training did not end by ``end``, on the clock of time.monotonic."""
        config = self.config
        train, test = (
            [Scene.open(path, fitting=config.data.fitting) for path in part] for part in (self.train, self.test)
        )
        asked = {
            "train": to_dict(config),
            "scenes": [[scene.name for scene in part] for part in (train, test)],
            "steps": [self.n_given, self.n_future],
            "cameras": self.targets,
        }
        known = _read(folder / SCORE)
        if all(known.get(name) == value for name, value in asked.items()):
            return known["result"]
        if time.monotonic() >= end:
            return {"trained": last_entry(folder).get("step", 0), "of": config.n_steps}
        trainer = Trainer(config, train, folder, device=self.device)
        if not trainer.same_scenes:
            raise InputError(f"{folder}: was trained on fewer scenes than are given now; use another folder")
        trainer.run(end=end, progress=progress)
        if trainer.step < config.n_steps:
            return {"trained": trainer.step, "of": config.n_steps}
        restored = restore(folder, self.device)
        start = self.n_given - config.data.history
        same = {"start": start, "n_future": self.n_future, "metrics": tuple(PSNRS)}
        scores = [
            score_scene(restored, scene, context_cams=context(scene, config), target_cams=cams, **same)
            for scene, cams in zip(test, self.targets, strict=True)
        ]
        summary = summarize(scores)
        result = {
            f"{method}{metric}": summary.get(f"{method}future.{metric}") for metric in PSNRS for method in METHODS
        }
        result["step_seconds"] = _step_seconds(folder, config)
        write_json(folder / SCORE, {**asked, "device": self.device, "result": result})
        return result


def attempt(folder: Path, trial: Trial, end: float, progress: bool) -> dict:
    """:meth:`Trial.run`, or why there is nothing to score."""
    try:
        return trial.run(folder, end, progress)
    except (NumericalError, CaptureError) as error:
        return {"failure": str(error)}
    except torch.OutOfMemoryError:
        return {"failure": "out of memory"}


def context(scene: Scene, config: TrainConfig) -> list[int]:
    """The cameras that a model of this run is given."""
    return spread_views(context_cameras(scene, config.data), config.data.context_views, 0)


def _read(file: Path) -> dict:
    try:
        known = parse_json(read_file(file, MAX_TEXT)) if file.is_file() else {}
    except ValueError:  # nothing but time is lost
        known = {}
    return known if isinstance(known, dict) and isinstance(known.get("result"), dict) else {}


def _step_seconds(run: Path, config: TrainConfig) -> float | None:
    """Of an optimizer step: the median of those logged in the last phase."""
    first = config.n_steps - config.phases[-1].steps
    entries = filter(None, map(read_entry, (run / LOG).read_bytes().splitlines()))
    spent = [entry["machine"]["step_seconds"] for entry in entries if entry["step"] >= first]
    return statistics.median(spent) if spent else None
