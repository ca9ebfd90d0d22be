"""Implementation of ``gsim3d capture``: from videos to a trained simulator, in steps that each write their result."""

import dataclasses
import json
import os
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsim3d.capture import check, prepare
from gsim3d.capture.board import Board
from gsim3d.capture.calibrate import calibrate
from gsim3d.capture.clips import BOARD, clips_in
from gsim3d.data import Scene, find_scenes, split_scenes
from gsim3d.data.check import check_scene
from gsim3d.data.layouts import layout_of
from gsim3d.data.recording import read_json
from gsim3d.data.videos import FILE
from gsim3d.errors import InputError, check_one_of
from gsim3d.evaluate.protocol import score_scene
from gsim3d.io.files import sha256_of, write_whole
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.nn.multiview_encoder.config import BACKBONES
from gsim3d.pretrained.loading import check_device
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.log import LOG
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore
from gsim3d.train.run import run_folder, train

PHASES = ((0, 0.35, 2e-3), (3, 0.25, 1e-3), (12, 0.4, 1e-3))  # horizon, share of the time, learning rate
DEPTH_RATE = 0.15  # learning rate of a pretrained encoder, relative to the other parts
BATCH = {"cpu": 1, "cuda": 4}
PROBED = 3  # optimizer steps of each phase that are timed
SCORED_STEPS = 12  # predicted steps of a scored window
MOST_WINDOWS = 24
RECORD = "capture.json"  # file of what the run folder belongs to
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
    """Turns videos into a simulator; finished steps are skipped when called again.

    Args:
        folder: videos of one take, or a folder of videos for each; scenes of any layout with cameras are used as given.
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
        InputError: videos or cameras cannot be used; the message names angles or reprojection errors. Or ``out`` was
            started with other videos, cameras or settings.
    """
    folder, out = Path(folder), Path(out)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    check_device(device)
    if depth:
        check_one_of("--depth: MODEL", depth[0], BACKBONES)
        if not Path(depth[1]).is_file():
            raise InputError(f"--depth: {depth[1]}: no such file")
        depth = depth[0], str(Path(depth[1]).resolve())
    with run_folder(out):
        run = _Run(folder, out, device, minutes, depth, force, say)
        run.check_same()
        run.calibrate(board, scale)
        run.step("check", run.check)
        write_whole(out / RECORD, json.dumps(run.given(), indent=1) + "\n")
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

    def given(self) -> dict[str, Any]:
        """Returns what the run folder belongs to, by name: settings, pretrained depth, cameras and videos."""
        depth = [self.depth[0], Path(self.depth[1]).name] if self.depth else None
        where = os.path.relpath(self.folder.resolve(), self.out.resolve())
        found = {"DIR": where, "device": self.device, "minutes": self.minutes, "depth": depth}
        found |= {depth[1]: f"sha256 {sha256_of(Path(self.depth[1]))}"} if depth else {}
        for take in self.takes():
            file = take / layout_of(take).FILE
            states = {file: f"sha256 {sha256_of(file)}"} if file.is_file() else {}
            states |= {clip: f"{clip.stat().st_size} bytes of {int(clip.stat().st_mtime)}" for clip in clips_in(take)}
            found |= {file.relative_to(self.folder).as_posix(): state for file, state in states.items()}
        return found

    def check_same(self) -> None:
        """Raises InputError if the run folder belongs to other videos or settings; both may have moved together."""
        if (self.out / RECORD).is_file() and (self.out / "check.json").is_file():
            before, given = read_json(self.out / RECORD), self.given()
            if changed := [name for name in (*given, *before) if before.get(name) != given.get(name)]:
                was = f"{self.out}: was started with {changed[0]} {before.get(changed[0])}; give the same"
                raise InputError(f"{was}, or another --out, or delete {self.out / 'check.json'} to begin anew")

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

    def takes(self) -> list[Path]:
        """Returns the scenes in the folder; videos without cameras are none."""
        with suppress(InputError):
            return find_scenes(self.folder)
        return []

    def scenes(self, part: str) -> list[Path]:
        return find_scenes(self.out / "scenes" / part)

    def calibrate(self, board: Board | None, scale) -> None:
        """Writes cameras.json of videos that have none; given ones are kept."""
        scenes, below = self.takes(), [path for path in sorted(self.folder.iterdir()) if path.name != BOARD]
        takes = [self.folder] if self.folder in scenes or clips_in(self.folder) else below
        recorded = [take for take in takes if take not in scenes and take.name[0] != "." and clips_in(take)]
        if not recorded and not scenes:
            raise InputError(f"{self.folder} contains no scene (docs/reference/data.md), and no videos <camera>.mp4")
        if not recorded:
            unused = "; --board and --scale have no effect: delete cameras.json to repeat it" if board or scale else ""
            self.say(f"calibrate: done, or cameras given ({', '.join(path.name for path in scenes)}){unused}")
            return
        started = self.out / "calibrating"  # exists while cameras.json of several takes are written
        if scenes and takes is below and not started.is_file():
            both = f"{recorded[0]}: has videos but no {FILE}, unlike {scenes[0]}"
            raise InputError(f"{both}: give its cameras, or calibrate all takes (gsim3d calibrate {self.folder})")
        started.touch()
        try:
            calibrate(self.folder, board=board, scale=scale, force=self.force, say=self.say)
        except InputError:
            started.unlink()
            raise
        started.unlink()

    def check(self) -> dict:
        """Refuses what cannot be learned from, unless forced."""
        problems: dict[str, Path] = {}  # and the first take that has each
        found, rig = {}, ""
        for path in find_scenes(self.folder):
            checked = check_scene(path)
            scene, own = checked.scene, list(checked.problems)
            if scene is None:
                raise InputError(own[0])
            if scene.cameras_move:
                raise InputError(f"{path}: a capture needs cameras that do not move")
            cameras = f"{', '.join(scene.camera_names)} of {list(scene.recorded_sizes)} pixels"
            if cameras != (rig := rig or cameras):
                raise InputError(f"{path}: has cameras {cameras}, other takes {rig}; give it a folder of its own")
            extra = [clip.name for clip in clips_in(path) if clip.stem not in scene.camera_names]
            own += [f"{path / FILE}: has no camera of {', '.join(extra)}: calibrate again"] if extra else []
            angles = check.angles(scene.recording.viewmats[0])
            errors = {} if own else check.match_errors(scene, angles)
            centres = None if own else check.centre_error(prepare.open_take(path, self.out / "cache"))
            own += [check.overlap_problem(scene.camera_names, angles), check.fit_problem(errors, scene.width)]
            own += [check.NO_CENTRE.format(*centres)] if centres and centres[0] > centres[1] else []
            problems |= {problem: path for problem in own if problem and problem not in problems}
            found[str(path)] = {"angles": angles.tolist(), "errors": errors, "centres": centres}
            self.say(f"  {path}: {check.summary(angles, errors, centres)}")
            if scene.has_actions():
                self.say("  its points of actors are not used; gsim3d train does (configs/train/hocap.yaml)")
        if problems and not self.force:
            (problem, path), more = next(iter(problems.items())), len(problems) - 1
            raise InputError(f"{path}: {problem}{f' (and {more} more problems)' if more else ''}; --force goes on")
        for problem, path in problems.items():
            self.say(f"  ignored, because of --force: {problem} ({path})")
        return {"takes": found, "ignored": list(problems)}

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
        shutil.rmtree(scenes, ignore_errors=True)
        for part, chosen in (("train", train), ("test", test)):
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
                context_views=min(len(proposal["crops"]) - (held_out is not None), 4),
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
        phases, slowest = [], 0.0
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
                slowest = max(slowest, min(seconds))
        return dataclasses.replace(config, phases=tuple(phases), checkpoint_every=max(1, int(60 / slowest)))

    def train(self, settings: dict) -> dict:
        """Trains the model, or continues; returns on what, how long and how many steps."""
        config = from_dict(TrainConfig, settings)
        train(config, self.scenes("train"), self.out / "model", device=self.device)
        seconds = json.loads((self.out / "model" / LOG).read_text().splitlines()[-1])["machine"]["seconds"]
        machine = torch.cuda.get_device_name() if self.device == "cuda" else self.device
        return {"device": machine, "minutes": round(seconds / 60, 2), "steps": config.n_steps}

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
            raise InputError(f"{self.out / 'scenes' / 'test'}: no moving body is visible; record longer, or more takes")
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
