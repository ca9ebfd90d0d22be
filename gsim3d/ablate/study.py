"""Trains and scores rows one after another, from where it was left, and keeps one table of what is done."""

from __future__ import annotations

import dataclasses
import json
import os
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from gsim3d.ablate.rows import Row
from gsim3d.ablate.table import METHODS, PSNRS, as_dict, markdown
from gsim3d.data import Scene, split_scenes
from gsim3d.effects import EffectsSpec
from gsim3d.errors import HardCaseError, InputError
from gsim3d.evaluate.protocol import horizon, score_scene
from gsim3d.evaluate.report import summarize, write_json
from gsim3d.files import MAX_TEXT, read_file
from gsim3d.plans import make_plan
from gsim3d.train.checks import check_history, check_sharing
from gsim3d.train.config import TrainConfig
from gsim3d.train.log import LOG
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import check_device, model_config, restore
from gsim3d.train.samples import check_scenes, context_cameras, spread_views
from gsim3d.train.settings import to_dict
from gsim3d.train.thawing import check_thawing

SCORE = "score.json"


class Study:
    """Rows of one base run on one data set.

    Args:
        base: the run that rows change.
        rows: to train; the others are compared with the first one.
        folders: of all scenes; those that `gsim3d train` holds out are scored, over the same steps and from the same
            cameras for all rows.
        n_seeds: runs of each row, which differ in their seed.
        device: "cpu" or "cuda".
    Raises:
        InputError: a row does not fit the data or the base run; nothing was trained or written by then.
    """

    def __init__(
        self, base: TrainConfig, rows: Sequence[Row], folders: Sequence[Path], *, n_seeds: int = 1, device: str = "cpu"
    ):
        check_device(device)
        if n_seeds < 1:
            raise InputError(f"--seeds must be at least 1; got {n_seeds}")
        if model_config(base).dynamics.explicit:
            raise InputError("preset: the base run must be of a latent model; the row explicit makes it explicit")
        if len(folders) < 2:
            raise InputError(f"{folders[0]}: a single scene; two are needed, of which one is held out")
        self.base, self.rows, self.n_seeds, self.device = base, list(rows), n_seeds, device
        self.train, self.test = (
            [Scene.open(folder, fitting=base.data.fitting) for folder in part] for part in split_scenes(folders)
        )
        self.configs = {row.name: self._checked(row) for row in rows}
        self.n_given = max(config.data.history for config in self.configs.values())
        self.n_future = min(horizon(scene, self.n_given, None) for scene in self.test)
        self.targets = [self._targets(scene) for scene in self.test]

    def _checked(self, row: Row) -> TrainConfig:
        """The row's run, all of its model written out; everything that can be known before training is checked."""
        try:
            config = row.change(self.base)
            model, effects = model_config(config), EffectsSpec.from_dict(config.effects)
            config = dataclasses.replace(config, model=to_dict(model), effects=effects.to_dict())
            check_scenes(self.train, config.data, config.stages)
            check_scenes(self.test, config.data, ())
            check_history(config, make_plan(effects, model))
            check_thawing(config.data, model.dynamics)
            check_sharing(config, 1, model.dynamics.norm)
        except InputError as error:
            raise InputError(f"row {row.name}: {error}") from None
        return config

    def _targets(self, scene: Scene) -> list[int]:
        """Cameras that are no input of any row, as far as there are any."""
        kept = list(self.base.data.target_only_cameras)
        inputs = {cam for config in self.configs.values() for cam in _context(scene, config)}
        return kept or sorted(set(range(scene.n_cams)) - inputs) or list(range(scene.n_cams))

    def same_as(self, name: str) -> str:
        """The first row whose run is that of the row ``name``: itself, where no earlier one is the same."""
        return next(other for other, config in self.configs.items() if config == self.configs[name])

    def run(self, out: Path, command: str, *, progress: bool = True, say: Callable[[str], None] = print) -> dict:
        """Trains and scores what is not done yet in the folder ``out``; what ablation.json holds.

        A row that diverges or has no memory is told in the table, and tried again by the next call.
        """
        out.mkdir(parents=True, exist_ok=True)
        names = list(dict.fromkeys(self.same_as(row.name) for row in self.rows))
        results: dict[str, list[dict]] = {}
        runs = [(seed, name) for seed in range(self.n_seeds) for name in names]
        for n, (seed, name) in enumerate(runs, 1):
            say(f"[{n}/{len(runs)}] {name}, seed {seed}")
            config = dataclasses.replace(self.configs[name], seed=self.configs[name].seed + seed)
            try:
                result = self._one(config, out / name / f"seed_{seed}", progress)
            except HardCaseError as error:
                result = {"failure": str(error)}
            except torch.OutOfMemoryError:
                result = {"failure": "out of memory"}
            results.setdefault(name, []).append(result)
            content = as_dict(self, results, command)
            write_json(out / "ablation.json", content)
            part = out / ".ablation.md.part"
            part.write_text(markdown(content))
            os.replace(part, out / "ablation.md")
        return content

    def _one(self, config: TrainConfig, folder: Path, progress: bool) -> dict:
        """What one run scores."""
        asked = {
            "train": to_dict(config),
            "scenes": [[scene.name for scene in part] for part in (self.train, self.test)],
            "steps": [self.n_given, self.n_future],
            "cameras": self.targets,
        }
        known = _read(folder / SCORE)
        if all(known.get(name) == value for name, value in asked.items()):
            return known["result"]
        trainer = Trainer(config, self.train, folder, device=self.device)
        if not trainer.same_scenes:
            raise InputError(f"{folder}: was trained on fewer scenes than are given now; use another folder")
        trainer.run(progress=progress)
        restored = restore(folder, self.device)
        start = self.n_given - config.data.history
        same = {"start": start, "n_future": self.n_future, "metrics": tuple(PSNRS)}
        scores = [
            score_scene(restored, scene, context_cams=_context(scene, config), target_cams=cams, **same)
            for scene, cams in zip(self.test, self.targets, strict=True)
        ]
        summary = summarize(scores)
        result = {
            f"{method}{metric}": summary.get(f"{method}future.{metric}") for metric in PSNRS for method in METHODS
        }
        result["step_seconds"] = _step_seconds(folder, config)
        write_json(folder / SCORE, {**asked, "device": self.device, "result": result})
        return result


def _context(scene: Scene, config: TrainConfig) -> list[int]:
    return spread_views(context_cameras(scene, config.data), config.data.context_views, 0)


def _read(file: Path) -> dict:
    try:
        known = json.loads(read_file(file, MAX_TEXT)) if file.is_file() else {}
    except ValueError:  # nothing but time is lost
        known = {}
    return known if isinstance(known, dict) and isinstance(known.get("result"), dict) else {}


def _step_seconds(run: Path, config: TrainConfig) -> float | None:
    """Of an optimizer step: the median of those logged in the last stage."""
    first = config.n_steps - config.stages[-1].steps
    entries = [json.loads(line) for line in (run / LOG).read_text().splitlines()]
    spent = [entry["machine"]["step_seconds"] for entry in entries if entry["step"] >= first]
    return statistics.median(spent) if spent else None
