"""Ablations: rows that change one thing, runs that go on after a kill, and differences that are no more than chance."""

import dataclasses
import json

import pytest

from gsim3d.ablate.rows import ROWS, base_run, rows_named, with_steps
from gsim3d.ablate.study import Study
from gsim3d.ablate.table import as_dict, markdown
from gsim3d.cli.main import main
from gsim3d.data import find_scenes
from gsim3d.errors import CaptureError, InputError, NumericalError
from gsim3d.train.captured import check_capturable
from gsim3d.train.config import DataConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import build_simulator, model_config
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")
BASE = TrainConfig(
    phases=(PhaseConfig(steps=2, horizon=1, target_views=1, learning_rate=1e-3),),
    data=DataConfig(context_views=2, target_only_cameras=(3,), background_stride=4),
    optimizer=OptimizerConfig(ema_decay=0),
    checkpoint_every=1,
)
KEYS = ("psnr", "psnr_masked", "constant.psnr_masked", "copy.psnr")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return find_scenes(write_scenes(tmp_path_factory.mktemp("scenes"), 3))


def study(folders, names, **options) -> Study:
    return Study(BASE, rows_named(names), folders, **options)


def quiet(*_):
    pass


def scores(content: dict) -> dict:
    return {row["row"]: {key: row.get(key) for key in (*KEYS, "difference")} for row in content["rows"]}


def test_every_row_changes_what_it_says_and_has_a_model():
    changed = {}
    for name, row in ROWS.items():
        base = base_run("small")
        config = row.change(base)
        model, before = model_config(config), model_config(base)
        parts = {part for part in ("encoder", "dynamics", "renderer") if getattr(model, part) != getattr(before, part)}
        parts |= {part for part in ("data", "phases", "effects") if getattr(config, part) != getattr(base, part)}
        changed[name] = parts
    assert {
        name: parts for name, parts in changed.items() if name.startswith(("latent", "explicit", "no-tem", "grid"))
    } == {
        "latent": set(),
        "explicit": {"encoder", "dynamics", "renderer"},
        "no-tem": {"dynamics"},
        "grid-half": {"dynamics"},
        "grid-double": {"dynamics"},
    }
    assert changed["rollout-2"] == {"phases"} and changed["rollout-12"] == set() == changed["history-4"]
    assert changed["history-1"] == {"data"} == changed["views-2"]
    assert changed["background-masked"] == {"effects"} and changed["calls-2"] == {"dynamics"}


@pytest.mark.parametrize("preset", ["tiny", "small"])
def test_the_explicit_row_is_a_model(preset):
    model = model_config(ROWS["explicit"].change(base_run(preset)))
    assert (
        build_simulator(model, 0).dynamics.config.explicit and model.dynamics.static_latents == model.encoder.static_dim
    )


def test_the_base_run_is_the_papers_as_far_as_the_preset_goes():
    assert [base_run(preset).data.history for preset in ("tiny", "small", "paper_latent")] == [2, 4, 4]
    assert base_run().phases[-1].horizon == 12


def test_a_budget_is_shared_by_the_stages():
    config = dataclasses.replace(BASE, phases=(PhaseConfig(steps=10), PhaseConfig(steps=40, horizon=1)))
    for n_steps in (2, 7, 50, 333):
        assert with_steps(config, n_steps).n_steps == n_steps
    assert [phase.steps for phase in with_steps(config, 100).phases] == [20, 80]
    with pytest.raises(InputError, match="--steps: must be at least 2"):
        with_steps(config, 1)


def test_killed_between_and_within_rows_the_table_is_that_of_one_sitting(folders, tmp_path, monkeypatch):
    whole = study(folders, "latent,no-tem").run(tmp_path / "whole", "c", progress=False, say=quiet)
    step, calls = Trainer.train_step, []

    def killed(trainer):
        calls.append(trainer.out)
        if len(calls) == 4:  # within the second row, after its first checkpoint
            raise KeyboardInterrupt
        return step(trainer)

    monkeypatch.setattr(Trainer, "train_step", killed)
    again, out = study(folders, "latent,no-tem"), tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        again.run(out, "c", progress=False, say=quiet)
    between = json.loads((out / "ablation.json").read_text())
    assert [len(row["runs"]) for row in between["rows"]] == [1, 0]
    content = again.run(out, "c", progress=False, say=quiet)
    assert [call.parent.name for call in calls] == ["latent"] * 2 + ["no-tem"] * 3
    assert scores(content) == scores(whole) and scores(between)["latent"] == scores(whole)["latent"]
    assert json.loads((out / "ablation.json").read_text()) == content
    again.run(out, "c", progress=False, say=quiet)
    assert len(calls) == 5  # nothing is trained again


def test_side_by_side_and_in_two_calls_the_table_is_that_of_one_after_another(folders, tmp_path):
    asked, out, said = study(folders, "latent", n_seeds=2), tmp_path / "together", []
    expected = asked.run(tmp_path / "one", "c", progress=False, say=quiet)
    late = asked.run(out, "c", minutes=1e-9, progress=False, say=said.append)
    assert late["rows"][0]["runs"] == [{"seed": seed, "trained": 0, "of": 2} for seed in (0, 1)]
    assert "latent, seed 1: 0 of 2 optimizer steps; call again to go on" in (out / "ablation.md").read_text()
    content = asked.run(out, "c", together=2, say=said.append)
    assert scores(content) == scores(expected)
    assert [run["seed"] for run in content["rows"][0]["runs"]] == [0, 1]
    assert [line.split(", seed")[0] for line in said if line[0] == "["] == ["[1/2] latent", "[2/2] latent"] * 2


def test_a_base_run_that_no_graph_can_repeat_is_refused_before_anything_is_trained(folders):
    base = dataclasses.replace(BASE, captured=True, model={"dynamics": {"drop_path": 0.1}})
    with pytest.raises(InputError, match="row latent: captured: the model must have drop_path 0"):
        Study(base, rows_named("latent"), folders)


@pytest.mark.parametrize("preset", ["tiny", "small"])
def test_every_row_of_a_small_base_run_can_come_from_graphs(preset):
    for row in ROWS.values():
        config = row.change(base_run(preset))
        assert config.captured
        check_capturable(model_config(config).dynamics)


def test_rows_of_other_histories_are_scored_over_the_same_steps(folders, tmp_path):
    content = study(folders, "latent,history-1,history-2").run(tmp_path, "c", progress=False, say=quiet)
    assert content["steps"] == {"before": 2, "predicted": 4}
    rows = {row["row"]: row for row in content["rows"]}
    assert rows["history-1"]["copy.psnr"] == pytest.approx(rows["latent"]["copy.psnr"], abs=1e-9)
    assert rows["history-2"]["same_as"] == "latent" and rows["history-2"]["runs"] == rows["latent"]["runs"]
    assert "is latent" in markdown(content) and not (tmp_path / "history-2").exists()


def test_rows_of_other_views_are_seen_by_cameras_that_none_was_given(folders):
    base = dataclasses.replace(BASE, data=dataclasses.replace(BASE.data, target_only_cameras=()))
    assert Study(base, rows_named("latent"), folders).targets == [[1, 3, 4]]  # inputs are 0 and 2
    assert Study(base, rows_named("latent,views-3"), folders).targets == [[4]]  # and 0, 1, 3
    assert study(folders, "latent,views-1").targets == [[3]]


def test_differences_within_the_spread_of_seeds_are_a_tie(folders):
    asked = study(folders, "latent,no-tem,rollout-2", n_seeds=3)

    def runs(*values):
        return [{**dict.fromkeys(KEYS, value), "copy.psnr_masked": None, "step_seconds": 0.1} for value in values]

    results = {"latent": runs(20.0, 20.5, 20.1), "no-tem": runs(20.4, 20.7, 20.6), "rollout-2": runs(18.0, 18.1, 18.2)}
    results["rollout-2"].append({"seed": 3, "failure": "step 7 is not finite"})
    content = as_dict(asked, results, "gsim3d ablate x")
    tie, lower = content["rows"][1:]
    assert tie["tie"] is True and tie["spread"] == pytest.approx(0.5) and not lower["tie"]
    lines = markdown(content).splitlines()
    assert "| tie (within 0.50) |" in lines[3] and "| -2.10 |" in lines[4]
    assert "rollout-2, seed 3: failed: step 7 is not finite" in lines
    assert "| 18.10 ± 0.10 |" in lines[4]
    single = as_dict(asked, {name: found[:1] for name, found in results.items()}, "c")
    assert single["rows"][1]["tie"] is None and "| +0.40 |" in markdown(single)


@pytest.mark.parametrize("error", [NumericalError, CaptureError])
def test_a_row_that_fails_is_told_and_the_others_go_on(error, folders, tmp_path, monkeypatch):
    step = Trainer.train_step

    def diverging(trainer):
        if not trainer.config.model["dynamics"]["time_embedding"]:
            raise error("20 steps in a row were skipped")
        return step(trainer)

    monkeypatch.setattr(Trainer, "train_step", diverging)
    content = study(folders, "no-tem,latent").run(tmp_path, "c", progress=False, say=quiet)
    assert content["rows"][0]["runs"] == [{"seed": 0, "failure": "20 steps in a row were skipped"}]
    assert content["rows"][1]["psnr"] > 0 and "no-tem, seed 0: failed: 20 steps in a row" in markdown(content)


def test_the_command_lists_rows_and_says_what_is_wrong(folders, tmp_path, capsys):
    assert main(["ablate", "--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(ROWS)
    data, out = str(folders[0].parents[1]), str(tmp_path / "out")
    (tmp_path / "long.yaml").write_text("phases: [{steps: 2, horizon: 9, target_views: 1}]\n")
    for arguments, message in (
        ([data, "--rows", "latent,none", "--out", out], "--rows: 'none' does not exist; rows: latent, explicit"),
        ([data, "--rows", "latent,latent", "--out", out], "named twice"),
        ([data, "--seeds", "0", "--out", out], "--seeds: must be at least 1"),
        ([data, "--together", "0", "--out", out], "--together: must be at least 1"),
        ([data, "--minutes", "0", "--out", out], "--minutes: must be a finite number above 0; got 0"),
        ([data, "--minutes", "inf", "--out", out], "--minutes: must be a finite number above 0; got inf"),
        ([data], "--out is needed"),
        ([str(folders[0]), "--out", out], "two are needed"),
        ([data, "--config", str(tmp_path / "long.yaml"), "--out", out], "row latent: "),
    ):
        assert main(["ablate", *arguments]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_of_another_run_is_refused(folders, tmp_path):
    study(folders, "latent").run(tmp_path, "c", progress=False, say=quiet)
    other = Study(with_steps(BASE, 3), rows_named("latent"), folders)
    with pytest.raises(InputError, match="was started with another 'phases'"):
        other.run(tmp_path, "c", progress=False, say=quiet)
    fewer = Study(BASE, rows_named("latent"), folders[:2])
    fewer.run(tmp_path / "fewer", "c", progress=False, say=quiet)
    with pytest.raises(InputError, match="was trained on fewer scenes than are given now"):
        study(folders, "latent").run(tmp_path / "fewer", "c", progress=False, say=quiet)
