"""Fuzzing (tests/stability/fuzz): no input may crash, hang, take memory without end or give a silent NaN."""

import json
import re
from pathlib import Path

import pytest

from gsim3d.cli.main import COMMANDS
from tests.stability.fuzz import commands
from tests.stability.fuzz.campaign import campaign
from tests.stability.fuzz.engine import Outcome, make_case, replay, run, targets
from tests.stability.fuzz.ops import OPS, public_ops
from tests.stability.fuzz.readers import READERS

FEW, PER_OP = 25, 2000  # inputs of each op in the fast tests, and in the full ones
FEW_FILES, PER_READER = 4, 2000  # damaged files of each reader: few, and many
READER_SECONDS, LEAST_FILES = 10, 5  # no further file after so long; so many are read on a busy machine, too
SPLATS = sorted(name for name in READERS if name.startswith(("ply", "splats", "spz")))
ENOUGH = 200  # inputs that are answered in several ways
FEW_COMMANDS, PER_COMMAND = 4, 200  # wrong arguments of each command: few, and many


def assert_none_failed(outcomes: list[Outcome], count: int, least: int | None = None) -> None:
    failed = [outcome for outcome in outcomes if outcome.failures]
    assert not failed, "\n".join(map(str, failed))
    for outcome in outcomes:
        assert (least or count) <= outcome.count <= count and outcome.count == sum(outcome.answers.values()), outcome


def assert_all_answered(outcomes: list[Outcome], count: int, least: int | None = None) -> None:
    assert_none_failed(outcomes, count, least)
    for outcome in outcomes:
        # Inputs that are all refused, or all computed, test nothing; where time was short few may be by chance.
        cut_short = least is not None and outcome.count < ENOUGH
        assert cut_short or 0.03 * outcome.count < outcome.answers.get("ok", 0) < 0.97 * outcome.count, outcome


def test_every_public_op_is_fuzzed():
    assert set(OPS) == public_ops() and set(OPS) <= set(targets())


def test_ops_answer_a_few_inputs(tmp_path):
    assert_all_answered(run(list(OPS), FEW, seed=1, out=tmp_path), FEW)


@pytest.mark.slow
@pytest.mark.parametrize("half", [0, 1])
def test_ops_answer_thousands_of_inputs(half, tmp_path):
    assert_all_answered(run(sorted(OPS)[half::2], PER_OP, out=tmp_path), PER_OP)


@pytest.mark.slow
def test_ops_answer_on_a_gpu(devices, tmp_path):
    outcomes = run([f"{name}@cuda" for name in OPS], 300, out=tmp_path)
    assert_all_answered(outcomes, 300)


def test_readers_answer_a_few_files(tmp_path):
    assert_none_failed(run(list(READERS), FEW_FILES, seed=1, out=tmp_path), FEW_FILES)


@pytest.mark.slow
@pytest.mark.parametrize("half", [0, 1])
def test_readers_of_splats_answer_all_files(half, tmp_path):
    assert_all_answered(run(SPLATS[half::2], PER_READER, out=tmp_path), PER_READER)


@pytest.mark.slow
@pytest.mark.parametrize("quarter", range(4))
def test_readers_answer_thousands_of_files(quarter, tmp_path):
    names = sorted(set(READERS) - set(SPLATS))[quarter::4]
    outcomes = run(names, PER_READER, out=tmp_path, seconds=READER_SECONDS)
    assert_all_answered(outcomes, PER_READER, LEAST_FILES)


def test_every_command_is_fuzzed():
    assert {f"command-{name}" for name in COMMANDS} == {target.name for target in commands.TARGETS}


def test_commands_refuse_a_few_wrong_arguments(tmp_path):
    assert_none_failed(
        run([target.name for target in commands.TARGETS], FEW_COMMANDS, seed=1, out=tmp_path), FEW_COMMANDS
    )


@pytest.mark.slow
def test_commands_refuse_hundreds_of_wrong_arguments(tmp_path):
    assert_none_failed(run([target.name for target in commands.TARGETS], PER_COMMAND, out=tmp_path), PER_COMMAND)


MISBEHAVIOUR = {
    "_crash": "ended by SIGABRT",
    "_hang": "hangs: no answer within 1 s",
    "_memory": "takes 12[0-9]{2} MiB; ok",
    "_nan": r"result.x\[0\] is not finite",
    "_unnamed": "ValueError does not say what is wrong",
    "_untyped": "KeyError at misbehaving.py",
}


@pytest.fixture(scope="module")
def misbehaved(tmp_path_factory):
    # Patience is short only where it runs out: a busy machine may need a second to take a gigabyte.
    hanging = run(["_hang"], 6, out=tmp_path_factory.mktemp("hanging"), patience=1.0)
    others = [name for name in MISBEHAVIOUR if name != "_hang"]
    outcomes = run(others, 6, out=tmp_path_factory.mktemp("misbehaved"))
    return {outcome.target: outcome for outcome in (*hanging, *outcomes)}


@pytest.mark.parametrize("target", MISBEHAVIOUR)
def test_the_engine_finds_what_must_not_happen_and_keeps_it(target, misbehaved):
    outcome = misbehaved[target]
    assert outcome.count == 6 and outcome.answers["ok"] >= 3
    text, kept = outcome.failures[0]
    assert re.search(MISBEHAVIOUR[target], text) and text.startswith("input 3:")
    description = json.loads((kept / "case.json").read_text())
    assert description["target"] == target and description["index"] == 3 and description["problem"] in text
    assert (kept / "input" / "note.txt").read_text() == "a file of the input"
    large = (kept / "input" / "large").stat()
    assert (kept / "input" / "pipe").is_fifo() and large.st_size == 2**32 and large.st_blocks < 2**11
    assert f"python -m tests.stability.fuzz --replay {kept}" in str(outcome)


def test_a_kept_input_can_be_run_again(misbehaved):
    kept = misbehaved["_unnamed"].failures[0][1]
    answers = [replay(kept)[0] for _ in range(4)]
    # A fresh process is good for three inputs; a replay tells what happens now.
    assert answers == ["ok", "ok", "ok", "ValueError"]


def test_a_child_that_cannot_start_is_no_failure_of_an_input(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(RuntimeError, match="ended with code 1 before it had an input"):
        run(["_good"], 2, out=tmp_path)


def test_a_campaign_goes_on_where_it_was(tmp_path, capsys):
    assert campaign(["_good"], 4, tmp_path, a_round=3) and not list(tmp_path.glob("_good-*"))
    assert not campaign(["_good", "_unnamed"], 6, tmp_path, a_round=6)
    totals = json.loads((tmp_path / "totals.json").read_text())
    assert {name: total["count"] for name, total in totals.items()} == {"_good": 6, "_unnamed": 6}
    text, kept = totals["_unnamed"]["failures"][0]
    assert "does not say what is wrong" in text and (Path(kept) / "case.json").is_file()
    said = capsys.readouterr().out
    assert [f"_good: {n} inputs" in said for n in (3, 1, 2, 4)] == [True, True, True, False]
    assert not campaign(["_good", "_unnamed"], 6, tmp_path)  # failures stay
    assert re.search(r"all +12 inputs, [1-9]\d* failures", capsys.readouterr().out)


def test_inputs_are_a_function_of_seed_and_number(tmp_path):
    target = targets()["_good"]
    folders = [tmp_path / str(number) for number in range(4)]
    for folder in folders:
        folder.mkdir()
    places = zip(((7, 0), (7, 0), (8, 0), (7, 1)), folders)
    cases = [make_case(target, seed, index, folder) for (seed, index), folder in places]
    assert cases[0] == cases[1] and len(set(cases)) == 3
