"""Implementation of ``gsim3d capture``: from films to a trained simulator, in steps that each write their result."""

import dataclasses
import json
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.capture import check, prepare
from gsim3d.capture.board import Board
from gsim3d.capture.calibrate import calibrate
from gsim3d.capture.films import BOARD, films_in
from gsim3d.data import Scene, find_scenes, split_scenes
from gsim3d.data.check import check_scene
from gsim3d.data.videos import FILE
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import score_scene
from gsim3d.io.files import write_whole
from gsim3d.io.locks import only_one_writer
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore
from gsim3d.train.run import train

PHASES = ((0, 0.35, 2e-3), (3, 0.25, 1e-3), (12, 0.4, 1e-3))  # horizon, share of the time, learning rate
BATCH = {"cpu": 1, "cuda": 4}
PROBED = 3  # optimizer steps of each phase that are timed
SCORED_STEPS = 12  # predicted steps of a scored window
MOST_WINDOWS = 24
FILES = {"check": "check.json", "propose": "proposal.json", "train": "train.json", "score": "metrics.json"}


def capture(
    folder: str | Path,
    out: str | Path,
    *,
    board: Board | None = None,
    scale: tuple[str, str, float] | None = None,
    minutes: float = 15.0,
    device: str = "cpu",
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
        force: go on where views do not overlap or a calibration does not fit.
        say: receives what was decided, and why.

    Returns:
        The content of metrics.json.

    Raises:
        InputError: films or cameras cannot be used; the message names angles or reprojection errors.
    """
    folder, out = Path(folder), Path(out)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    out.mkdir(parents=True, exist_ok=True)
    with only_one_writer(out):
        run = _Run(folder, out, device, minutes, force, say)
        run.calibrate(board, scale)
        run.step("check", run.check)
        proposal = run.step("propose", run.propose)
        run.step("train", lambda: run.train(proposal))
        scores = run.step("score", run.score)
    say(f"view: gsim3d view {run.scenes('test')[0]} --checkpoint {out / 'model'}")
    return scores


class _Run:
    def __init__(self, folder: Path, out: Path, device: str, minutes: float, force: bool, say: Callable[[str], None]):
        self.folder, self.out, self.say = folder, out, say
        self.device, self.minutes, self.force = device, minutes, force

    def step(self, name: str, compute: Callable[[], Any]) -> Any:
        """Returns the result of a step, read from its file if it exists, else computed and written."""
        file = self.out / FILES[name]
        if file.is_file():
            self.say(f"{name}: done ({file})")
            return json.loads(file.read_text())
        self.say(f"{name}:")
        result = compute()
        write_whole(file, json.dumps(result, indent=1) + "\n")
        return json.loads(file.read_text())

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
        self.say(f"calibrate: done, or cameras given ({', '.join(names)})")

    def check(self) -> dict:
        """Refuses what cannot be learned from, unless forced."""
        problems, angles, errors = [], None, {}
        for path in find_scenes(self.folder):
            found = check_scene(path)
            problems += found.problems
            if found.scene is None:
                raise InputError(found.problems[0])
            if found.scene.cameras_move:
                raise InputError(f"{path}: a capture needs cameras that do not move")
            if angles is None:
                names = found.scene.camera_names
                angles = check.angles(found.scene.recording.viewmats[0])
                problems += [check.overlap_problem(names, angles)]
                errors = check.match_errors(found.scene, angles)
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
        train, test = ([(take, range(take.n_steps)) for take in part] for part in split_scenes(takes))
        if not test:
            take = takes[0]
            end = take.n_steps - max(self._least_steps(), round(prepare.HELD_OUT_SHARE * take.n_steps))
            if end < self._least_steps():
                raise InputError(f"{take.path}: {take.n_steps} frames; at least {2 * self._least_steps()} are needed")
            train, test = [(take, range(end))], [(take, range(end, take.n_steps))]
            self.say(f"  held out: the last {take.n_steps - end} of {take.n_steps} frames")
        else:
            self.say(f"  held out: {', '.join(take.name for take, _ in test)}")
        scenes = self.out / "scenes"
        for part, chosen in (("train", train), ("test", test)):
            (scenes / part).mkdir(parents=True, exist_ok=True)
            for take, steps in chosen:
                prepare.write_scene(take, proposal, steps, scenes / part / take.path.resolve().name)
        shutil.rmtree(cache)
        return dataclasses.asdict(proposal)

    def _least_steps(self) -> int:
        return prepare.HISTORY[self.device] + 2

    def train(self, proposal: dict) -> dict:
        """Trains the model; returns the settings."""
        folders = self.scenes("train")
        file = self.out / "settings.json"  # kept for a training that was interrupted
        if file.is_file():
            config = from_dict(TrainConfig, json.loads(file.read_text()))
        else:
            config = self._timed(self._config(proposal, folders), folders)
            write_whole(file, json.dumps(to_dict(config), indent=1) + "\n")
        train(config, folders, self.out / "model", device=self.device)
        return to_dict(config)

    def _config(self, proposal: dict, folders: list[Path]) -> TrainConfig:
        history, device = prepare.HISTORY[self.device], self.device
        shortest = min(Scene.open(folder).n_steps for folder in folders)
        held_out = proposal["held_out_camera"]
        n_inputs = len(proposal["crops"]) - (held_out is not None)
        phase = {"batch": BATCH[device], "warm_up": 0.1}
        horizons = sorted({min(horizon, shortest - history) for horizon, _, _ in PHASES})
        phases = [
            PhaseConfig(1, horizon, learning_rate=rate, **phase) for horizon, (_, _, rate) in zip(horizons, PHASES)
        ]
        gpu = {"dynamics": {"drop_path": 0.0, "shuffle_orders": False}} if device == "cuda" else {}
        return TrainConfig(
            preset=prepare.PRESETS[device],
            model=gpu,
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
        probe = dataclasses.replace(
            config, phases=tuple(dataclasses.replace(phase, steps=PROBED) for phase in config.phases)
        )
        phases = []
        with tempfile.TemporaryDirectory() as temporary:
            trainer = Trainer(probe, scenes, temporary, device=self.device)
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

    def score(self) -> dict:
        """Scores windows of the held-out steps against the constant baseline."""
        restored, differences, values = restore(self.out / "model", self.device), [], {"model": [], "constant": []}
        metric = "psnr_masked"
        for folder in self.scenes("test"):
            scene = restored.open_scene(folder)
            n_future = min(SCORED_STEPS, scene.n_steps - restored.n_encoded)
            starts = range(0, scene.n_steps - restored.n_encoded - n_future + 1, n_future)
            for start in starts[: MOST_WINDOWS - len(differences)]:
                window = {"start": start, "n_future": n_future, "metrics": [metric], "methods": ["constant"]}
                scores = score_scene(restored, scene, **window)
                means = {m: float(scores.values[m][metric][scores.n_encoded :].nanmean()) for m in values}
                for method, value in means.items():
                    values[method].append(value)
                differences.append(means["model"] - means["constant"])
        gain = float(np.mean(differences))
        error = float(np.std(differences, ddof=1) / np.sqrt(len(differences))) if len(differences) > 1 else None
        means = {method: float(np.mean(own)) for method, own in values.items()}
        beats = error is not None and gain > 2 * error
        verdict = "above" if beats else "not above"
        spread = "one window, no error" if error is None else f"+- {error:.2f}"
        self.say(
            f"  masked PSNR of {len(differences)} held-out windows: model {means['model']:.2f} dB, constant "
            f"{means['constant']:.2f} dB: {gain:+.2f} dB ({spread}), {verdict} constant by two standard errors"
        )
        return {**means, "gain": gain, "standard_error": error, "windows": len(differences), "above_constant": beats}
