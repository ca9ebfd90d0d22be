"""Implementation of ``gsim3d capture``: from films to a trained simulator, in steps that each write their result."""

import dataclasses
import json
import os
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsim3d.capture import check, prepare
from gsim3d.capture.board import Board
from gsim3d.capture.calibrate import calibrate
from gsim3d.capture.films import BOARD, films_in
from gsim3d.data import Scene, find_scenes, split_scenes
from gsim3d.data.check import check_scene
from gsim3d.data.recording import read_json
from gsim3d.data.videos import FILE
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import score_scene
from gsim3d.io.files import write_whole
from gsim3d.io.locks import only_one_writer
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.nn.multiview_encoder.config import ViTConfig
from gsim3d.pretrained.loading import check_device
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.log import LOG
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore
from gsim3d.train.run import train

PHASES = ((0, 0.35, 2e-3), (3, 0.25, 1e-3), (12, 0.4, 1e-3))  # horizon, share of the time, learning rate
DEPTH_RATE = 0.15  # learning rate of a pretrained encoder, relative to the other parts
BATCH = {"cpu": 1, "cuda": 4}
PROBED = 3  # optimizer steps of each phase that are timed
SCORED_STEPS = 12  # predicted steps of a scored window
MOST_WINDOWS = 24
# Files of the steps' results in the run folder, without their ending .json.
FILES = {"check": "check", "propose": "proposal", "settings": "settings", "train": "train", "score": "metrics"}


def capture(
    folder: str | Path,
    out: str | Path,
    *,
    board: Board | None = None,
    scale: tuple[str, str, float] | None = None,
    minutes: float = 15.0,
    device: str = "cpu",
    depth: tuple[str, str] | None = None,
    force: bool = False,
    say: Callable[[str], None] = print,
) -> dict:
    """Turns films into a simulator; finished steps are skipped when called again.

    Args:
        folder: films of one take, or a folder of films for each; scenes of any layout with cameras are used as given.
        out: run folder. Delete a step's file there to repeat it and what follows.
        board, scale: see :func:`gsim3d.capture.calibrate.calibrate`.
        minutes: time to train.
        device: "cpu" or "cuda".
        depth: model and .safetensors file of a pretrained depth encoder, see
            :class:`gsim3d.nn.multiview_encoder.config.ViTConfig`; None: plane sweep.
        force: go on where views do not overlap or a calibration does not fit.
        say: receives what was decided, and why.

    Returns:
        The content of metrics.json.

    Raises:
        InputError: films or cameras cannot be used; the message names angles or reprojection errors. Or ``out`` was
            started with other films or settings.
    """
    folder, out = Path(folder), Path(out)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    check_device(device)
    if depth:
        ViTConfig(depth[0])  # raises if there is no such model
        if not Path(depth[1]).is_file():
            raise InputError(f"--depth: {depth[1]}: no such file")
        depth = depth[0], str(Path(depth[1]).resolve())
    out.mkdir(parents=True, exist_ok=True)
    with only_one_writer(out):
        run = _Run(folder, out, device, minutes, depth, force, say)
        run.check_same()
        run.calibrate(board, scale)
        run.step("check", run.check)
        proposal = run.step("propose", run.propose)
        settings = run.step("settings", lambda: run.settings(proposal))
        trained = run.step("train", lambda: run.train(settings))
        scores = run.step("score", lambda: run.score(trained))
    say(f"view: {shlex.join(['gsim3d', 'view', str(run.scenes('test')[0]), '--checkpoint', str(out / 'model')])}")
    return scores


@dataclasses.dataclass
class _Run:
    folder: Path
    out: Path
    device: str
    minutes: float
    depth: tuple[str, str] | None
    force: bool
    say: Callable[[str], None]

    def check_same(self) -> None:
        """Raises InputError if the run folder belongs to other films or settings; both may have moved together."""
        depth = [self.depth[0], Path(self.depth[1]).name] if self.depth else None
        films = os.path.relpath(self.folder.resolve(), self.out.resolve())
        given = {"DIR": films, "device": self.device, "minutes": self.minutes, "depth": depth}
        file = self.out / "capture.json"
        before = read_json(file) if file.is_file() else given
        if changed := [key for key in given if before.get(key) != given[key]]:
            was = ", ".join(f"{key} {before.get(key)}" for key in changed)
            raise InputError(f"{self.out}: was started with {was}; give the same, or another --out")
        write_whole(file, json.dumps(given, indent=1) + "\n")

    def step(self, name: str, compute: Callable[[], Any]) -> Any:
        """Returns the result of a step, read from its file if it exists, else computed and written."""
        file = self.out / f"{FILES[name]}.json"
        if file.is_file():
            self.say(f"{name}: done ({file})")
            return read_json(file)
        self.say(f"{name}:")
        for later in list(FILES)[list(FILES).index(name) + 1 :]:
            (self.out / f"{FILES[later]}.json").unlink(missing_ok=True)
        result = compute()
        write_whole(file, json.dumps(result, indent=1) + "\n")
        return read_json(file)

    def scenes(self, part: str) -> list[Path]:
        return find_scenes(self.out / "scenes" / part)

    def calibrate(self, board: Board | None, scale) -> None:
        """Writes cameras.json where films have none."""
        below = [path for path in self.folder.iterdir() if path.is_dir() and path.name != BOARD]
        filmed = [take for take in (self.folder, *below) if films_in(take)]
        if filmed and not all((take / FILE).is_file() for take in filmed):
            calibrate(self.folder, board=board, scale=scale, force=self.force, say=self.say)
            return
        try:
            names = [path.name for path in find_scenes(self.folder)]
        except InputError as error:
            raise InputError(f"{error}; and no films <camera>.mp4") from None
        unused = "; --board and --scale have no effect: delete cameras.json to repeat it" if board or scale else ""
        self.say(f"calibrate: done, or cameras given ({', '.join(names)}){unused}")

    def check(self) -> dict:
        """Refuses what cannot be learned from, unless forced."""
        problems, angles, errors = [], None, {}
        for path in find_scenes(self.folder):
            found = check_scene(path)
            problems += found.problems
            if found.scene is None:
                raise InputError(found.problems[0])
            extra = [film.name for film in films_in(path) if film.stem not in found.scene.camera_names]
            problems += [f"{path / FILE}: has no camera of {', '.join(extra)}: calibrate again"] if extra else []
            if found.scene.cameras_move:
                raise InputError(f"{path}: a capture needs cameras that do not move")
            if angles is None:
                angles = check.angles(found.scene.recording.viewmats[0])
                errors = {} if found.problems else check.match_errors(found.scene, angles)
                problems += [check.overlap_problem(found.scene.camera_names, angles)]
                problems += [check.fit_problem(errors, found.scene.width)]
        problems = [problem for problem in problems if problem]
        nearest = np.where(np.eye(len(angles), dtype=bool), np.inf, angles).min(1)
        self.say(f"  angles to the nearest camera: {', '.join(f'{angle:.0f}' for angle in nearest)} degrees")
        worst = max((error for error, _ in errors.values()), default=None)
        fit = "too few to judge" if worst is None else f"at most {worst:.2f} px ({len(errors)} pairs of cameras)"
        self.say(f"  reprojection error of matched features: {fit}")
        if problems and not self.force:
            more = f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else ""
            raise InputError(f"{self.folder}: {problems[0]}{more}; --force goes on")
        for problem in problems:
            self.say(f"  ignored, because of --force: {problem}")
        return {"angles": angles.tolist(), "errors": errors, "ignored": problems}

    def propose(self) -> dict:
        """Writes the prepared scenes, and returns the proposal."""
        cache = self.out / "cache"
        takes = [prepare.open_take(path, cache) for path in find_scenes(self.folder)]
        proposal = prepare.propose(takes, self.device, self.say)
        least = prepare.HISTORY[self.device] + 2
        train, test = ([(take, range(take.n_steps)) for take in part] for part in split_scenes(takes))
        if not test:
            take = takes[0]
            end = max(0, take.n_steps - max(least, round(prepare.HELD_OUT_SHARE * take.n_steps)))
            train, test = [(take, range(end))], [(take, range(end, take.n_steps))]
            self.say(f"  held out: the last {take.n_steps - end} of {take.n_steps} frames")
        else:
            self.say(f"  held out: {', '.join(take.name for take, _ in test)}")
        for take, steps in train + test:
            if len(steps) < least:
                raise InputError(f"{take.path}: has {len(steps)} usable frames at {take.fps:g} a second, needs {least}")
        scenes = self.out / "scenes"
        for part, chosen in (("train", train), ("test", test)):
            (scenes / part).mkdir(parents=True, exist_ok=True)
            for take, steps in chosen:
                below = take.path.resolve().relative_to(self.folder.resolve()).parts or (self.folder.resolve().name,)
                prepare.write_scene(take, proposal, steps, scenes / part / "_".join(below))
        shutil.rmtree(cache)
        return dataclasses.asdict(proposal)

    def settings(self, proposal: dict) -> dict:
        """Returns the settings of a new training."""
        shutil.rmtree(self.out / "model", ignore_errors=True)
        folders = self.scenes("train")
        return to_dict(self._timed(self._config(proposal, folders), folders))

    def _config(self, proposal: dict, folders: list[Path]) -> TrainConfig:
        history, device = prepare.HISTORY[self.device], self.device
        shortest = min(Scene.open(folder).n_steps for folder in folders)
        held_out = proposal["held_out_camera"]
        n_inputs = len(proposal["crops"]) - (held_out is not None)
        horizons = sorted({min(horizon, shortest - history) for horizon, _, _ in PHASES})
        phase = {"steps": PROBED, "batch": BATCH[device], "warm_up": 0.1}
        phase["encoder_rate"] = DEPTH_RATE if self.depth else 1.0
        phases = [PhaseConfig(horizon=n, learning_rate=rate, **phase) for n, (*_, rate) in zip(horizons, PHASES)]
        model = {"dynamics": {"drop_path": 0.0, "shuffle_orders": False}} if device == "cuda" else {}
        model["encoder"] = {"latent_limit": 4.0}
        if self.depth:
            model["encoder"] |= {"backbone": "vit_dpt", "vit": {"model": self.depth[0]}}
        return TrainConfig(
            preset=prepare.PRESETS[device],
            model=model,
            pretrained_depth=self.depth[1] if self.depth else "",
            phases=tuple(phases),
            data=DataConfig(
                history=history,
                context_views=min(n_inputs, 4),
                target_only_cameras=() if held_out is None else (held_out,),
                body_stride=proposal["body_stride"],
                background_stride=proposal["body_stride"],
                leave_one_out=True,
            ),
            loss=LossConfig(body_weight=2.0, image_gain=True),
            optimizer=OptimizerConfig(clip_norm=1.0, ema_decay=0.98),
            captured=device == "cuda",
        )

    def _timed(self, config: TrainConfig, folders: list[Path]) -> TrainConfig:
        """Returns the configuration with as many steps as fit into the time to train."""
        scenes = [Scene.open(folder) for folder in folders]
        phases = []
        with tempfile.TemporaryDirectory() as temporary:
            trainer = Trainer(config, scenes, temporary, device=self.device)
            trainer.simulator.train()
            shares = np.array([share for _, share, _ in PHASES[: len(config.phases)]])
            for phase, share in zip(config.phases, shares / shares.sum(), strict=True):
                seconds = []
                for _ in range(PROBED):
                    start = time.perf_counter()
                    trainer.train_step()
                    seconds.append(time.perf_counter() - start)
                steps = max(1, int(60 * self.minutes * share / min(seconds)))
                self.say(f"  phase with {phase.horizon} simulated steps: {steps} steps of {min(seconds):.2f} s")
                phases.append(dataclasses.replace(phase, steps=steps))
        return dataclasses.replace(config, phases=tuple(phases))

    def train(self, settings: dict) -> dict:
        """Trains the model, or continues; returns on what, how long and how many steps."""
        config = from_dict(TrainConfig, settings)
        train(config, self.scenes("train"), self.out / "model", device=self.device)
        last = (self.out / "model" / LOG).read_text().splitlines()[-1]
        minutes = round(json.loads(last)["machine"]["seconds"] / 60, 2)
        machine = torch.cuda.get_device_name() if self.device == "cuda" else self.device
        return {"device": machine, "minutes": minutes, "steps": config.n_steps}

    def score(self, trained: dict) -> dict:
        """Scores windows of the held-out steps against the constant baseline."""
        restored, metric = restore(self.out / "model", self.device), "psnr_masked"
        values: dict[str, list[float]] = {"model": [], "constant": [], "copy": []}  # of each window
        for folder in self.scenes("test"):
            scene = restored.open_scene(folder)
            n_future = min(SCORED_STEPS, scene.n_steps - restored.n_encoded)
            starts = range(0, scene.n_steps - restored.n_encoded - n_future + 1, n_future)
            for start in starts[: MOST_WINDOWS - len(values["model"])]:
                window = {"start": start, "n_future": n_future, "metrics": [metric], "methods": ["constant", "copy"]}
                scores = score_scene(restored, scene, **window)
                found = [float(scores.values[method][metric][scores.n_encoded :].nanmean()) for method in values]
                for own, value in zip(values.values(), found, strict=True):
                    own += [value] if np.isfinite(found).all() else []
        if not values["model"]:
            raise InputError(f"{self.out / 'scenes' / 'test'}: no moving body is visible; film longer, or more takes")
        differences = np.subtract(values["model"], values["constant"])
        gain, count = float(differences.mean()), len(differences)
        error = float(np.std(differences, ddof=1) / np.sqrt(count)) if count > 1 else None
        means = {method: float(np.mean(own)) for method, own in values.items()}
        beats = error is not None and gain > 2 * error
        spread = "one window, no error" if error is None else f"+- {error:.2f}"
        self.say(
            f"  masked PSNR of {count} held-out windows: {', '.join(f'{n} {x:.2f} dB' for n, x in means.items())}; "
            f"{gain:+.2f} dB ({spread}), {'' if beats else 'not '}above constant by two standard errors"
        )
        result = {"gain": gain, "standard_error": error, "windows": count, "above_constant": beats}
        return {**trained, **means, **result, "of_windows": values}
