"""Checkpoints: whole or absent, checked when read, readable without running code."""

import dataclasses
import json
import math
import os
import resource
import signal
import subprocess
import sys

import pytest
import safetensors.torch
import torch

from gsim3d.errors import InputError, NumericalError
from gsim3d.io import checkpoint
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.io.files import sha256_of


def example(step=10, **changes):
    generator = torch.Generator().manual_seed(step)
    weights = {name: torch.randn(3, 2, generator=generator) for name in ("encoder.weight", "dynamics.weight")}
    fields = {
        "model": weights,
        "ema": {name: value + 1 for name, value in weights.items()},
        "optimizer": {"exp_avg.encoder.weight": torch.zeros(3, 2)},
        "config": {"model": {"a": 1}, "data": {"history": 2}, "train": {"seed": 3}},
        "state": {"step": step, "next_sample": 2 * step},
    }
    return Checkpoint(**{**fields, **changes})


def test_spec(tmp_path):
    before = example()
    folder = checkpoint.save(tmp_path, before)
    assert folder == tmp_path / "checkpoints" / "step_000010"
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.yaml", "ema.safetensors", "model.safetensors", "optimizer.safetensors", "state.json",
    ]  # fmt: skip
    for path in (tmp_path, folder):
        after = checkpoint.load(path)
        assert after.config == before.config
        assert after.state["step"] == 10 and after.state["next_sample"] == 20 and after.state["versions"]["torch"]
        for name in ("model", "ema", "optimizer"):
            assert getattr(after, name).keys() == getattr(before, name).keys()
            assert all(torch.equal(value, getattr(before, name)[key]) for key, value in getattr(after, name).items())


def test_pointer_names_the_newest_and_old_ones_go(tmp_path):
    for step in (5, 10, 15):
        checkpoint.save(tmp_path, example(step), keep=2)
    assert (tmp_path / "checkpoints" / "last").read_text() == "step_000015"
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["last", "step_000010", "step_000015"]
    assert checkpoint.load(tmp_path).state["step"] == 15
    assert not checkpoint.exists(tmp_path / "other") and checkpoint.exists(tmp_path)


def test_kill_while_writing_leaves_the_last_one_good(tmp_path):
    checkpoint.save(tmp_path, example(5))
    script = (
        "import os, signal\n"
        "from gsim3d.io import checkpoint\n"
        "from tests.io.test_checkpoint import example\n"
        "checkpoint._sync = lambda path: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"checkpoint.save({str(tmp_path)!r}, example(10))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": os.getcwd()})
    assert done.returncode == -signal.SIGKILL
    assert checkpoint.load(tmp_path).state["step"] == 5
    checkpoint.save(tmp_path, example(10))
    assert checkpoint.load(tmp_path).state["step"] == 10


@pytest.mark.parametrize("file", ["model.safetensors", "ema.safetensors", "optimizer.safetensors", "config.yaml"])
def test_truncated_changed_or_missing_file_is_named(tmp_path, file):
    folder = checkpoint.save(tmp_path, example())
    content = (folder / file).read_bytes()
    for broken in (content[:-3], content[:-1] + bytes([content[-1] ^ 1]), None):
        (folder / file).unlink()
        if broken is not None:
            (folder / file).write_bytes(broken)
        with pytest.raises(InputError, match=file):
            checkpoint.load(tmp_path)
        (folder / file).write_bytes(content)
    checkpoint.load(tmp_path)


def test_broken_checkpoint_names_newest_whole_one(tmp_path):
    for step in (5, 10, 15):
        checkpoint.save(tmp_path, example(step), keep=3)
    for step in (10, 15):
        file = tmp_path / "checkpoints" / f"step_0000{step}" / "model.safetensors"
        file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(
        InputError, match=r"step_000015/model.safetensors: .*truncated.*; step_000005 beside it is whole"
    ):
        checkpoint.load(tmp_path)
    pointer = tmp_path / "checkpoints" / "last"
    pointer.write_text("step_000005")
    assert checkpoint.load(tmp_path).state["step"] == 5
    pointer.write_text("")
    with pytest.raises(InputError, match="step_000005 beside it is whole"):
        checkpoint.load(tmp_path)


@pytest.mark.parametrize("room", [0, 100, 400])
def test_full_disk_raises_and_keeps_last_checkpoint(tmp_path, room):
    """Files may not grow beyond ``room`` bytes."""
    checkpoint.save(tmp_path, example(5))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        with pytest.raises(
            InputError, match="step_000010: cannot be written: File too large; checkpoints before it"
        ) as refused:
            checkpoint.save(tmp_path, example(10))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "make room" in str(refused.value)
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["last", "step_000005"]
    assert checkpoint.load(tmp_path).state["step"] == 5
    checkpoint.save(tmp_path, example(10))
    assert checkpoint.load(tmp_path).state["step"] == 10


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such checkpoint"):
        checkpoint.load(tmp_path / "missing")
    with pytest.raises(InputError, match="not a checkpoint"):
        checkpoint.load(tmp_path)
    checkpoint.export(example(), tmp_path / "b.safetensors")
    for content in (b"something else", (tmp_path / "b.safetensors").read_bytes()[:-1]):
        (tmp_path / "a.safetensors").write_bytes(content)
        with pytest.raises(InputError, match="truncated, or not a gsim3d checkpoint file"):
            checkpoint.load(tmp_path / "a.safetensors")
    folder = checkpoint.save(tmp_path, example())
    (folder / "state.json").write_text("{")
    with pytest.raises(InputError, match="state.json"):
        checkpoint.load(folder)


def write_state(folder, state):
    """With a hash that fits."""
    state.pop(checkpoint.OWN_HASH, None)
    (folder / "state.json").write_text(json.dumps({**state, checkpoint.OWN_HASH: checkpoint.hash_of_state(state)}))


@pytest.mark.parametrize("key, value", [("step", 4), ("n_skipped", 3), ("loss_scale", [1.0, 3]), ("scenes", ["b"])])
def test_changed_state_is_refused(tmp_path, key, value):
    folder = checkpoint.save(tmp_path, example())
    state = json.loads((folder / "state.json").read_text())
    (folder / "state.json").write_text(json.dumps({**state, key: value}))
    with pytest.raises(InputError, match="state.json: changed since it was written"):
        checkpoint.load(folder)


def test_state_without_its_own_hash_is_one_of_an_earlier_version(tmp_path):
    folder = checkpoint.save(tmp_path, example())
    state = json.loads((folder / "state.json").read_text())
    del state[checkpoint.OWN_HASH]
    (folder / "state.json").write_text(json.dumps(state))
    assert checkpoint.load(folder).state["step"] == 10


WRONG = [
    ("step", "10"), ("step", 1.5), ("step", -1), ("step", True), ("step", None), ("step", 2**70),
    ("next_sample", []), ("n_skipped", "none"), ("n_skipped_in_a_row", 0.5), ("seconds", "long"),
    ("seconds", float("inf")), ("seconds", float("nan")), ("loss_scale", 3), ("loss_scale", ["a", 0]), ("scenes", "ab"),
    ("scenes", [1]), ("parent", 3), ("sha256", ["a"]), ("sha256", {"config.yaml": 3}),
]  # fmt: skip


@pytest.mark.parametrize("key, value", WRONG)
def test_values_of_a_wrong_type_are_named(tmp_path, key, value):
    folder = checkpoint.save(tmp_path, example())
    write_state(folder, {**json.loads((folder / "state.json").read_text()), key: value})
    with pytest.raises(InputError, match=f"state.json: {key} must be .*; the checkpoint is broken"):
        checkpoint.load(folder)


def single(path, config=None, state=None):
    """A single file of hostile metadata."""
    good = json.dumps({"format": 1, "model": {}, "data": {}}), json.dumps({"step": 3})
    texts = [text if given is None else given for given, text in zip((config, state), good)]
    metadata = dict(zip(("gsim3d_config", "gsim3d_state"), texts))
    path.write_bytes(safetensors.torch.save({"a": torch.zeros(1)}, metadata))
    return path


@pytest.mark.parametrize(
    "metadata",
    [
        {"config": "[]"}, {"config": "3"}, {"config": "null"}, {"config": "[" * 100_000},
        {"config": '{"format": [[1]]}'},
        {"config": '{"format": 1, "model": [], "data": {}}'}, {"config": "{"}, {"state": "[]"}, {"state": '"text"'},
        {"state": '{"step": "three"}'}, {"state": "{}"}, {"state": "[" * 100_000}, {"state": '{"step": 1e999}'},
        {"config": "1" + "0" * 5000},
    ],
)  # fmt: skip
def test_single_file_with_hostile_metadata_is_refused(tmp_path, metadata):
    assert checkpoint.load(single(tmp_path / "good.safetensors")).state["step"] == 3
    with pytest.raises(InputError, match="m.safetensors: ") as error:
        checkpoint.load(single(tmp_path / "m.safetensors", **metadata))
    assert len(str(error.value)) < 300 + len(str(tmp_path))


@pytest.mark.parametrize("part", ["model", "ema", "optimizer"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_weights_that_are_not_finite_are_neither_written_nor_read(tmp_path, part, bad, monkeypatch):
    checkpoint.save(tmp_path, example(5))
    wrong = example(10)
    name = next(iter(getattr(wrong, part)))
    getattr(wrong, part)[name][1, 1] = bad
    with pytest.raises(NumericalError, match=f"{name}: holds numbers that are not finite; nothing is written") as error:
        checkpoint.save(tmp_path, wrong)
    assert error.value.tensor == name
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["last", "step_000005"]
    if part != "optimizer":
        with pytest.raises(NumericalError, match="not finite"):
            checkpoint.export(dataclasses.replace(wrong, ema=getattr(wrong, part)), tmp_path / "a.safetensors")
        assert not list(tmp_path.glob("*.safetensors"))
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "first_not_finite", lambda tensors: None)
        folder = checkpoint.save(tmp_path, wrong)
    with pytest.raises(InputError, match=f"{part}.safetensors: {name} holds numbers that are not finite"):
        checkpoint.load(folder)


def test_another_format_is_refused(tmp_path):
    folder = checkpoint.save(tmp_path, example())
    config = (folder / "config.yaml").read_text().replace("format: 1", "format: 99")
    (folder / "config.yaml").write_text(config)
    state = json.loads((folder / "state.json").read_text())
    state["sha256"]["config.yaml"] = sha256_of(folder / "config.yaml")
    write_state(folder, state)
    with pytest.raises(InputError, match="format 99"):
        checkpoint.load(folder)


def test_single_file_holds_the_averaged_weights_and_the_config(tmp_path):
    before = example()
    checkpoint.save(tmp_path, before)
    checkpoint.export(checkpoint.load(tmp_path), tmp_path / "a.safetensors")
    with safetensors.safe_open(tmp_path / "a.safetensors", "pt") as file:
        assert json.loads(file.metadata()["gsim3d_config"])["model"] == {"a": 1}
    after = checkpoint.load(tmp_path / "a.safetensors")
    assert after.config == before.config and after.state["step"] == 10
    assert after.state["parent"] == checkpoint.load(tmp_path).digest
    assert all(torch.equal(value, before.ema[name]) for name, value in after.weights.items())


def test_others_may_read_what_the_umask_lets_them_read(tmp_path):
    folder = checkpoint.save(tmp_path, example())
    checkpoint.export(example(), tmp_path / "model.safetensors")
    plain = tmp_path / "plain"
    plain.touch()
    modes = {path.name: path.stat().st_mode for path in [*folder.iterdir(), tmp_path / "model.safetensors"]}
    assert set(modes.values()) == {plain.stat().st_mode}, modes
