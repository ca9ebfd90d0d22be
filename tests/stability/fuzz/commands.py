"""Every command with arguments of which one is wrong: exit code 2, one line that says so, nothing written."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import functools
import importlib
import io
import os
import random
import shutil
import tempfile
from functools import partial
from pathlib import Path

from gsim3d.cli.main import COMMANDS, main
from gsim3d.io import checkpoint, write_ply
from tests.stability.fuzz.engine import Failure, Target
from tests.stability.fuzz.readers import _gaussians, _saved
from tests.tiny_scenes import write_scenes

TRAINING = """
data: {history: 2, context_views: 2, target_only_cameras: [3], background_stride: 2}
phases:
  - {steps: 1, horizon: 1, target_views: 2}
"""
# What each command takes: {good} has files to read, {out} does not exist, {file} is in the way of every output.
RIGHT = {
    "generate": "elastic --out {out} --frames 2 --trajectories 1 --size 8 --processes 1",
    "bound": "{good}/data --given 34.4 --out {out}",
    "check-data": "{good}/data --out {out}.png",
    "calibrate": "{good}/none --scale a b 1",  # videos are not there: no run is started
    "capture": "{good}/none --out {out} --minutes 0.01 --depth tiny {good}/model.safetensors",
    "train": "{good}/train.yaml --data {good}/data --out {out} --until 1",
    "simulate": "{good}/model.safetensors {good}/data/ball/0000 --out {out} --steps 1",
    "export": "{good}/a.ply --to {out}.splat",
    "view": "{good}/a.ply",
    "plan": "{good}/data/ball/0000 {good}/model.safetensors",
    "effects": "infer {good}/data/ball/0000 {good}/model.safetensors --out {out}.yaml",
    "profile": "{good}/model.safetensors {good}/data --out {out} --quiet",
    "ablate": "{good}/data --rows latent --config {good}/train.yaml --out {out} --quiet",
    "reproduce": "{good}/model.safetensors --data {good}/data --out {out} --steps 1 --budget 0.01",
    "evaluate": "{good}/model.safetensors {good}/data --out {out} --steps 1",
    "weights": "lpips --from {good}/train.yaml",
    "import": "{good}/model.safetensors --config {good}/train.yaml --out {out}",
    "demo": "--out {out}",
    "doctor": "--stability {good}/model.safetensors --out {out} --steps 1",
}
FREE = ("bound", "check-data", "train", "effects", "evaluate", "doctor")  # their outputs have a default
OUTPUTS = ("out", "to", "export", "cache")
NO_NUMBER = ("", "x", "nan", "inf", "-inf", "1e400", "0x10", "1,5", "--", "²", "1" * 5000)
NO_WHOLE_NUMBER = (*NO_NUMBER, "-1", "1.5", "1e3")
NO_CHOICE = ("", "x", "CPU", "a" * 5000, "\udcff")
NO_INPUT = ("none", "none/none", "{file}/x", "{file}", "a" * 5000, "\udcff", "~", "/dev/null", "a\nb", "none.yaml")
NO_OUTPUT = ("{file}/x", "{file}/x/y", "a" * 5000, "{file}/x.safetensors", "/dev/null/x")
UNKNOWN = ("--no-such", "-x", "--out-of", "--")


@functools.cache
def _good() -> Path:
    """A folder with a data set, a model and a configuration, made once a process."""
    place = Path(tempfile.mkdtemp(prefix="fuzz-good-"))
    atexit.register(shutil.rmtree, place, True)
    write_scenes(place / "data", 3)
    (place / "train.yaml").write_text(TRAINING)
    checkpoint.export(_saved(), place / "model.safetensors")
    write_ply(place / "a.ply", _gaussians())
    return place


@functools.cache
def _options(command: str) -> list[argparse.Action]:
    parser = argparse.ArgumentParser(add_help=False)
    importlib.import_module(COMMANDS[command][0]).add_arguments(parser)
    return [action for action in parser._actions if action.option_strings and action.nargs != 0]


def _wrong(action: argparse.Action, rng: random.Random) -> str:
    if action.type is int:
        return rng.choice(NO_WHOLE_NUMBER if action.dest not in ("seed", "start", "frame") else NO_NUMBER)
    if action.type is float:
        return rng.choice(NO_NUMBER)
    if action.choices is not None:
        return rng.choice(NO_CHOICE)
    return rng.choice(NO_OUTPUT if action.dest in OUTPUTS else NO_INPUT)


def _make(command: str, rng: random.Random, folder: Path) -> list[str]:
    """Right arguments with a wrong one. Paths of the input's own folder are written {out} and {file}."""
    arguments = RIGHT[command].split()
    options, kind = _options(command), rng.random()
    if kind < 0.7 and options:
        action = rng.choice(options)
        option = action.option_strings[-1]
        wrong = [option, *[_wrong(action, rng) for _ in range(action.nargs if isinstance(action.nargs, int) else 1)]]
        if option in arguments:
            place = arguments.index(option)
            arguments[place : place + 2] = wrong
        else:
            place = rng.choice((0, len(arguments)))
            arguments[place:place] = wrong
    elif kind < 0.8 and command not in FREE:
        place = arguments.index("--out") if "--out" in arguments else 0
        del arguments[place : place + 2]
    elif kind < 0.9:
        arguments.insert(rng.choice((0, len(arguments))), rng.choice(UNKNOWN[:-1]))
    else:
        arguments = [rng.choice(("", "x", "--x", "Train", "a" * 5000)), *arguments]
        return arguments
    return [command, *arguments]


def _call(arguments: list[str], folder: Path) -> None:
    file, out = folder / "file", folder / "out"
    file.write_text("in the way")
    values = {"good": _good(), "out": out, "file": file}
    arguments = [_filled(text, values) for text in arguments]
    errors, before = io.StringIO(), os.getcwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
            try:
                code = main(arguments)
            except SystemExit as end:
                code = end.code
    finally:
        os.chdir(before)
    if code != 2:
        raise Failure(f"exit code {code} of {arguments}; {errors.getvalue()[-300:]}")
    lines = errors.getvalue().splitlines()
    if len(lines) != 1 or not lines[0].startswith("gsim3d: error: ") or len(lines[0]) < 25:
        raise Failure(f"not one line that says what is wrong, of {arguments}: {lines[:3]}")
    left = sorted(path.name for path in folder.iterdir() if path != file)
    if left or file.read_text() != "in the way":
        raise Failure(f"{left} was written by {arguments}")


def _filled(text: str, values: dict[str, Path]) -> str:
    for name, path in values.items():
        text = text.replace(f"{{{name}}}", str(path))
    return text


TARGETS = [Target(f"command-{name}", partial(_make, name), _call, ()) for name in COMMANDS]
