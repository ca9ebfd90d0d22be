"""The page of tables: measured within a budget, continued, compared with the last run."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from gsim3d.cli.main import main
from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.evaluate.ablations import load_ablations
from gsim3d.evaluate.protocol import score_scene
from gsim3d.evaluate.report import summarize
from gsim3d.evaluate.scoring import SceneScores
from gsim3d.reproduce import run
from gsim3d.reproduce.cells import from_json, to_json
from gsim3d.reproduce.run import Job, reproduce
from gsim3d.train.restore import restore
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")
TRAINING = """
data: {history: 2, context_views: 2, target_only_cameras: [3], background_stride: 4}
phases:
  - {steps: 2, horizon: 1, target_views: 2}
"""


@pytest.fixture(scope="module")
def work(tmp_path_factory, one_thread):
    """Sets of a world and two models."""
    root = tmp_path_factory.mktemp("work")
    write_scenes(root / "sets" / "elastic", 2)
    write_scenes(root / "sets" / "elastic-train", 3)
    (root / "train.yaml").write_text(TRAINING)
    for name in ("one", "two"):
        arguments = ["--data", root / "sets" / "elastic-train", "--out", root / "runs" / name, "--seed", len(name)]
        arguments = [*arguments[:4], "--export", root / f"{name}.safetensors"]
        assert main(["train", *map(str, [root / "train.yaml", *arguments])]) == 0
    return root


def made(work, out, **options) -> tuple[dict, dict]:
    """(content, lines by table and row) of a call; prints are kept in the content."""
    said = []
    models = [str(work / f"{name}.safetensors") for name in options.pop("models", ("one",))]
    job = Job(str(out), models, data=str(work / "sets"), **options)
    content, files = reproduce(job, "gsim3d reproduce", said.append)
    assert all(file.stat().st_size for file in files)
    return {**content, "said": said}, {(line["table"], line["row"]): line for line in content["lines"]}


@pytest.fixture(scope="module")
def first(work):
    return made(work, work / "out", models=("one", "two"))


def test_every_row_of_the_data_is_there(first, work):
    content, lines = first
    main_rows = [row for table, row in lines if table == "Main table"]
    assert main_rows == ["one", "constant", "copy", "constant velocity", "two"]
    assert ("Speed", "one") in lines and ("Edits", "one") in lines
    assert ("History length at inference", "two, 1 steps") in lines
    assert lines["Main table", "one"]["paper_other_data"] == "33.15 ± 3.51"
    page = (work / "out" / "reproduce.md").read_text()
    for text in ("momentum [m/s]", "other data", "## Missing", "needs --device cuda: spring-gaus (ball/0000)", "±"):
        assert text in page, text
    reasons = " ".join(content["missing"])
    assert "4 steps" in reasons and "trained with 2 input steps of 2 cameras" in reasons
