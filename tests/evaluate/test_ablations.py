"""Ablations: rows that change one thing, runs that go on after a kill, and paired differences with their error."""

import dataclasses
import json

import pytest

from gsim3d.cli.main import main
from gsim3d.data import find_scenes
from gsim3d.errors import CaptureError, InputError, NumericalError
from gsim3d.evaluate.ablations import (
    Study,
    as_dict,
    base_run,
    changed,
    load_ablations,
    markdown,
    paired_difference,
    rows_named,
    with_steps,
)  # fmt: skip
from gsim3d.simulator import Simulator
from gsim3d.train.captured import check_capturable
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import build_simulator, model_config
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")
BASES, ROWS = load_ablations()
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


def study(folders, names, base=BASE, **options) -> Study:
    return Study(base, rows_named(names, ROWS), folders, **options)


def run(study, out, **options) -> dict:
    return study.run(out, "c", **{"progress": False, "say": lambda line: None, **options})


def scores(content: dict) -> dict:
    return {row["row"]: {key: row.get(key) for key in (*KEYS, "difference")} for row in content["rows"]}


def test_rows_change_what_they_say():
    parts = ("encoder", "dynamics", "renderer", "data", "phases", "effects")
    base = changed(BASES["small"], {})
    found = {}
    for name, row in ROWS.items():
        config = changed(BASES["small"], row.change)
        before, after = ({**model_config(c).__dict__, **c.__dict__} for c in (base, config))
        found[name] = {part for part in parts if after[part] != before[part]}
    same = {"latent", "rollout-12", "history-4", "background-frozen", "background-dynamic", "calls-1"}
    assert {name for name, changes in found.items() if not changes} <= same
    assert found["explicit"] == {"encoder", "dynamics", "renderer"}
    assert found["no-tem"] == found["grid-half"] == found["grid-double"] == found["calls-2"] == {"dynamics"}
    assert found["rollout-2"] == {"phases"} and found["history-1"] == found["views-2"] == {"data"}
    assert found["background-masked"] == {"effects"} and found["no-masks"] == {"data"}
    assert changed(BASES["small"], ROWS["no-masks"].change).loss.body_weight == 0 < base.loss.body_weight


def test_grid_rows_scale_the_base():
    cells = [
        model_config(changed(BASE, ROWS[n].change)).dynamics.grid_size for n in ("grid-half", "latent", "grid-double")
    ]
    assert cells == pytest.approx([0.5 * cells[1], cells[1], 2 * cells[1]])


@pytest.mark.parametrize("preset", ["tiny", "small"])
def test_explicit_row_is_a_model(preset):
    model = model_config(changed(BASES[preset], ROWS["explicit"].change))
    dynamics = build_simulator(model, 0).dynamics.config
    assert dynamics.explicit and dynamics.static_latents == model.encoder.static_dim
    assert dynamics.static_latents == model_config(BASES[preset]).dynamics.static_latents // 2


def test_base_runs_are_the_papers_as_far_as_the_preset_goes():
    assert {name: base.data.history for name, base in BASES.items()} == {"tiny": 2, "small": 4, "paper_latent": 4}
    for name, base in BASES.items():
        assert base.preset == name and base.phases[-1].horizon == 12
        assert base.data.history <= 2 ** model_config(base).dynamics.history_bits


@pytest.mark.parametrize("preset", ["tiny", "small"])
def test_rows_of_small_base_runs_can_be_captured(preset):
    for row in ROWS.values():
        config = changed(BASES[preset], row.change)
        assert config.captured
        check_capturable(model_config(config).dynamics)


def test_steps_are_shared_by_the_phases():
    config = dataclasses.replace(BASE, phases=(PhaseConfig(steps=10), PhaseConfig(steps=40, horizon=1)))
    for n_steps in (2, 7, 50, 333):
        assert with_steps(config, n_steps).n_steps == n_steps
    assert [phase.steps for phase in with_steps(config, 100).phases] == [20, 80]
    with pytest.raises(InputError, match="--steps: must be at least 2"):
        with_steps(config, 1)
    assert base_run(BASES, "small", n_steps=300).n_steps == 300


def test_base_run_takes_a_preset_or_a_configuration(tmp_path):
    (tmp_path / "train.yaml").write_text("preset: tiny")
    with pytest.raises(InputError, match="--preset: cannot be combined with --config"):
        base_run(BASES, "tiny", tmp_path / "train.yaml")
    assert base_run(BASES, None, tmp_path / "train.yaml").preset == "tiny"
    assert base_run(BASES) == BASES["tiny"]


def test_killed_study_goes_on_to_the_same_table(folders, tmp_path, monkeypatch):
    whole = run(study(folders, "latent,no-tem"), tmp_path / "whole")
    step, calls = Trainer.train_step, []

    def killed(trainer):
        calls.append(trainer.out)
        if len(calls) == 4:  # within the second row, after its first checkpoint
            raise KeyboardInterrupt
        return step(trainer)

    monkeypatch.setattr(Trainer, "train_step", killed)
    again, out = study(folders, "latent,no-tem"), tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        run(again, out)
    between = json.loads((out / "ablation.json").read_text())
    assert [len(row["runs"]) for row in between["rows"]] == [1, 0]
    content = run(again, out)
    assert [call.parent.name for call in calls] == ["latent"] * 2 + ["no-tem"] * 3
    assert scores(content) == scores(whole) and scores(between)["latent"] == scores(whole)["latent"]
    assert json.loads((out / "ablation.json").read_text()) == content
    run(again, out)
    assert len(calls) == 5  # no finished run is trained again


def test_runs_in_processes_score_as_one_after_another(folders, tmp_path):
    asked, out = study(folders, "latent", n_seeds=2), tmp_path / "together"
    expected = run(asked, tmp_path / "one")
    late = run(asked, out, minutes=1e-9)
    assert late["rows"][0]["runs"] == [{"seed": seed, "trained": 0, "of": 2} for seed in (0, 1)]
    assert "latent, seed 1: 0 of 2 optimizer steps; run again to resume" in (out / "ablation.md").read_text()
    said = []
    content = run(asked, out, together=2, say=said.append)
    assert scores(content) == scores(expected)
    assert [found["seed"] for found in content["rows"][0]["runs"]] == [0, 1]
    assert [line.split(", seed")[0] for line in said] == ["[1/2] latent", "[2/2] latent"]


def test_rows_of_other_histories_are_scored_over_the_same_steps(folders, tmp_path):
    content = run(study(folders, "latent,history-1,history-2"), tmp_path)
    assert content["steps"] == {"before": 2, "predicted": 4}
    rows = {row["row"]: row for row in content["rows"]}
    assert rows["history-1"]["copy.psnr"] == pytest.approx(rows["latent"]["copy.psnr"], abs=1e-9)
    assert rows["history-2"]["same_as"] == "latent" and rows["history-2"]["runs"] == rows["latent"]["runs"]
    assert "same as latent" in markdown(content) and not (tmp_path / "history-2").exists()


def test_labels_are_read_neither_in_training_nor_in_scoring(folders, tmp_path, monkeypatch):
    base, seen = dataclasses.replace(BASE, loss=LossConfig(body_weight=2.0)), []
    encode = Simulator.encode

    def encoded(self, frames, **options):
        seen.append((self.training, bool(frames.masks.all() and frames.dynamic.all())))
        return encode(self, frames, **options)

    monkeypatch.setattr(Simulator, "encode", encoded)
    (row,) = run(study(folders, "no-masks", base), tmp_path)["rows"]
    assert set(seen) == {(True, True), (False, True)} and row["psnr_masked"] > 0


def test_targets_are_cameras_that_no_row_has_as_input(folders):
    base = dataclasses.replace(BASE, data=dataclasses.replace(BASE.data, target_only_cameras=()))
    assert study(folders, "latent", base).targets == [[1, 3, 4]]  # inputs are 0 and 2
    assert study(folders, "latent,views-3", base).targets == [[4]]  # and 0, 1, 3
    assert study(folders, "latent,views-1").targets == [[3]]


def runs(*by_scene, first_seed=0):
    return [
        {"seed": first_seed + n, "psnr": sum(v) / len(v), "psnr_masked": sum(v) / len(v), "psnr_body": None,
         "constant.psnr": 9.0, "copy.psnr": 8.0, "step_seconds": 0.1, "by_scene": {"psnr_masked": list(v)}}
        for n, v in enumerate(by_scene)
    ]  # fmt: skip


def test_paired_difference_is_of_the_same_seeds_and_scenes():
    first = runs((20.0, 30.0), (21.0, 31.0))
    found = paired_difference(runs((21.0, 31.2), (22.2, 32.4)), first, "psnr_masked")
    assert found["difference"] == pytest.approx(1.2) and not found["tie"]
    assert found["standard_error"] == pytest.approx(0.1)  # scenes differ by 10 dB, pairs do not
    assert found["difference"] > 2 * found["standard_error"]
    assert paired_difference(runs((20.5, 29.5), (21.5, 30.6)), first, "psnr_masked")["tie"]
    alone = paired_difference(runs((25.0,)), runs((24.0,)), "psnr_masked")
    assert alone == {"difference": 1.0, "standard_error": None, "tie": None}
    assert paired_difference(runs((25.0,), first_seed=7), first[:1], "psnr_masked") == {}


def test_table_names_ties_and_failures(folders):
    asked = study(folders, "latent,no-tem,rollout-2", n_seeds=3)
    results = {
        "latent": runs((20.0,), (20.5,), (20.1,)),
        "no-tem": runs((20.4,), (20.2,), (20.3,)),
        "rollout-2": [*runs((18.0,), (18.4,), (18.2,)), {"seed": 3, "failure": "step 7 is not finite"}],
    }
    content = as_dict(asked, results, "gsim3d ablate x")
    assert [row["tie"] for row in content["rows"][1:]] == [True, False]
    lines = markdown(content).splitlines()
    assert "| tie (+0.10 ± 0.21) |" in lines[3] and "| -2.00 ± 0.06 |" in lines[4]
    assert "rollout-2, seed 3: failed: step 7 is not finite" in lines
    assert "| 18.20 ± 0.20 (-, -) |" in lines[4]


@pytest.mark.parametrize("error", [NumericalError, CaptureError])
def test_failed_row_leaves_the_others(error, folders, tmp_path, monkeypatch):
    step = Trainer.train_step

    def diverging(trainer):
        if not trainer.config.model["dynamics"]["time_embedding"]:
            raise error("20 steps in a row were skipped")
        return step(trainer)

    monkeypatch.setattr(Trainer, "train_step", diverging)
    content = run(study(folders, "no-tem,latent"), tmp_path)
    assert content["rows"][0]["runs"] == [{"seed": 0, "failure": "20 steps in a row were skipped"}]
    assert content["rows"][1]["psnr"] > 0 and "no-tem, seed 0: failed: 20 steps in a row" in markdown(content)


def test_command_lists_rows_and_refuses_wrong_input(folders, tmp_path, capsys):
    assert main(["ablate", "--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(ROWS)
    data, out = str(folders[0].parents[1]), str(tmp_path / "out")
    (tmp_path / "long.yaml").write_text("phases: [{steps: 2, horizon: 9, target_views: 1}]\n")
    (tmp_path / "none.yaml").write_text("rows: 3\n")
    for arguments, message in (
        ([data, "--rows", "latent,none", "--out", out], "--rows: 'none' does not exist; rows: latent, explicit"),
        ([data, "--rows", "latent,latent", "--out", out], "repeats a row"),
        ([data, "--preset", "tinny", "--out", out], "must be one of tiny, small, paper_latent; got 'tinny'"),
        ([data, "--table", str(tmp_path / "none.yaml"), "--out", out], "none.yaml: must contain bases and rows"),
        ([data, "--table", str(tmp_path / "absent.yaml"), "--out", out], "absent.yaml: does not exist"),
        ([data, "--seeds", "0", "--out", out], "--seeds: must be at least 1"),
        ([data, "--together", "0", "--out", out], "--together: must be at least 1"),
        ([data, "--minutes", "0", "--out", out], "--minutes: must be a finite number above 0; got 0"),
        ([data], "--out is required"),
        ([str(folders[0]), "--out", out], "at least two are needed"),
        ([data, "--config", str(tmp_path / "long.yaml"), "--out", out], "row latent: "),
    ):
        assert main(["ablate", *arguments]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_folder_of_another_run_is_refused(folders, tmp_path):
    run(study(folders, "latent"), tmp_path)
    with pytest.raises(InputError, match="was started with a different 'phases'"):
        run(study(folders, "latent", with_steps(BASE, 3)), tmp_path)
    run(study(folders[:2], "latent"), tmp_path / "fewer")
    with pytest.raises(InputError, match="was trained on fewer scenes than given now"):
        run(study(folders, "latent"), tmp_path / "fewer")
