"""PSNR against hours of training, from logs as runs write them and as they travel with a simulator."""

import json
import math

import pytest

from gsim3d.errors import InputError
from gsim3d.profile import budget


def write_log(file, psnrs, seconds=360.0):
    lines = [
        {"step": 20 * n, "past_psnr": 20.0, "future_psnr": psnr, "machine": {"seconds": seconds * n}}
        for n, psnr in enumerate(psnrs)
    ]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return file


def test_hours_until_the_psnr_stays(tmp_path):
    """Steps before any simulation count as training; a share that is lost again was not reached."""
    log = budget.read_log(write_log(tmp_path / "metrics.jsonl", [None, 10.0, 30.0, 20.0, 29.0, 30.0, 30.0]))
    assert log.steps == (0, 20, 40, 60, 80, 100, 120)
    assert log.hours == pytest.approx([0.1 * n for n in range(7)])
    assert math.isnan(log.future[0]) and log.shown is log.future
    assert log.hours_to(0.99) == pytest.approx(0.5)
    assert log.hours_to(0.95) == pytest.approx(0.4)
    content = budget.as_dict(log)
    assert content["future"][0] is None and content["hours_to"] == {
        "90%": pytest.approx(0.4),
        "99%": pytest.approx(0.5),
    }


def test_without_simulated_steps_the_given_ones_are_shown(tmp_path):
    log = budget.read_log(write_log(tmp_path / "metrics.jsonl", [None, None]))
    assert log.shown == (20.0, 20.0) and log.hours_to(0.99) == 0
    assert budget.read_log(write_log(tmp_path / "empty.jsonl", [])) is None
    assert budget.as_dict(None) is None


def test_many_lines_are_averaged(tmp_path):
    values = [30.0 + (-1) ** n for n in range(200)]
    log = budget.read_log(write_log(tmp_path / "metrics.jsonl", values))
    assert max(log.future[10:-10]) - min(log.future[10:-10]) < 0.5


def test_a_file_that_is_no_log_is_told(tmp_path):
    for text in ("not json\n", '{"step": 1, "past_psnr": 20.0}\n', "[1]\n"):
        (tmp_path / "metrics.jsonl").write_text(text)
        with pytest.raises(InputError, match="metrics.jsonl: not the log of a training"):
            budget.read_log(tmp_path / "metrics.jsonl")


@pytest.mark.parametrize(
    "line",
    [
        b"\xff" * 5000,
        b'{"past_psnr": 1.0, "step": 1e999, "machine": {"seconds": 1}}',
        b"[" * 50_000,
        b'{"past_psnr": 1.0, "step": "' + b"x" * 5000 + b'", "machine": {}}',
    ],
)
def test_a_log_of_anything_is_told_in_one_short_line(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_bytes(line + b"\n")
    with pytest.raises(InputError, match="not the log of a training") as error:
        budget.read_log(tmp_path / "metrics.jsonl")
    assert len(str(error.value)) < 250 + len(str(tmp_path))


def test_where_a_log_lies(tmp_path):
    checkpoints = tmp_path / "run" / "checkpoints"
    for step in (100, 200, 300):
        (checkpoints / f"step_{step:06d}").mkdir(parents=True)
    (checkpoints / "last").write_text("step_000300\n")
    log = write_log(tmp_path / "run" / "metrics.jsonl", [20.0])
    assert budget.log_of(tmp_path / "run") == log
    assert budget.log_of(checkpoints / "step_000100") == log
    assert list(budget.earlier_checkpoints(tmp_path / "run")) == ["step 000100", "step 000200"]
    assert budget.earlier_checkpoints(checkpoints / "step_000100") == {}
    alone = tmp_path / "model.safetensors"
    alone.write_bytes(b"")
    assert budget.log_of(alone) is None and budget.earlier_checkpoints(alone) == {}
    shipped = write_log(tmp_path / "training.jsonl", [20.0])
    assert budget.log_of(alone) == shipped
