"""Trains and scores rows, from where it was left, and keeps one table of what is done."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from gsim3d.ablate.rows import Row
from gsim3d.ablate.table import as_dict, markdown, told
from gsim3d.ablate.trial import Trial, attempt, context
from gsim3d.data import Scene, split_scenes
from gsim3d.effects.plan import make_plan
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import horizon
from gsim3d.evaluate.report import write_json
from gsim3d.io.settings import to_dict
from gsim3d.train.captured import check_capturable
from gsim3d.train.config import TrainConfig, check_settings
from gsim3d.train.restore import check_device, model_config
from gsim3d.train.samples import check_scenes
from gsim3d.train.side_by_side import side_by_side


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
            check_scenes(self.train, config.data, config.phases)
            check_scenes(self.test, config.data, ())
            check_settings(config, model.dynamics, make_plan(effects, model))
            if config.captured:
                check_capturable(model.dynamics)
        except InputError as error:
            raise InputError(f"row {row.name}: {error}") from None
        return config

    def _targets(self, scene: Scene) -> list[int]:
        """Cameras that are no input of any row, as far as there are any."""
        kept = list(self.base.data.target_only_cameras)
        inputs = {cam for config in self.configs.values() for cam in context(scene, config)}
        return kept or sorted(set(range(scene.n_cams)) - inputs) or list(range(scene.n_cams))

    def same_as(self, name: str) -> str:
        """The first row whose run is that of the row ``name``: itself, where no earlier one is the same."""
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
        """Trains and scores what is not done yet in the folder ``out``; what ablation.json holds.

        A row that diverges or has no memory is told in the table, and tried again by the next call.

        Args:
            together: runs at a time, each in a process of its own.
            minutes: after which training stops; the next call goes on there.
            progress: whether bars, or lines where runs go together, say how far they are.
        """
        end = time.monotonic() + 60 * minutes
        out.mkdir(parents=True, exist_ok=True)
        names = list(dict.fromkeys(self.same_as(row.name) for row in self.rows))
        runs = {f"{name}, seed {seed}": (name, seed) for seed in range(self.n_seeds) for name in names}
        jobs = {
            text: (out / name / f"seed_{seed}", self._trial(name, seed), end, progress and together == 1)
            for text, (name, seed) in runs.items()
        }
        results: dict[str, dict[int, dict]] = {name: {} for name in names}
        for n, (text, result) in enumerate(side_by_side(attempt, jobs, together, say if progress else None), 1):
            name, seed = runs[text]
            results[name][seed] = {"seed": seed, **result}
            say(f"[{n}/{len(runs)}] {text}: {told(result)}")
            by_seed = {name: [known[seed] for seed in sorted(known)] for name, known in results.items()}
            content = as_dict(self, by_seed, command)
            write_json(out / "ablation.json", content)
            part = out / ".ablation.md.part"
            part.write_text(markdown(content))
            os.replace(part, out / "ablation.md")
        return content

    def _trial(self, name: str, seed: int) -> Trial:
        config = self.configs[name]
        config = dataclasses.replace(config, seed=config.seed + seed)
        folders = ([scene.path for scene in part] for part in (self.train, self.test))
        return Trial(config, *folders, self.targets, self.n_given, self.n_future, self.device)
