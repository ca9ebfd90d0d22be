"""gsim3d plan, gsim3d effects infer, and edits and specs of gsim3d simulate."""

import dataclasses
import itertools
import re

import pytest

from gsim3d import presets
from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec
from gsim3d.evaluate.infer_effects import propose, smaller_settings
from gsim3d.evaluate.plan_report import PartTimes, workload
from gsim3d.io import read_ply
from gsim3d.profile import autotune
from gsim3d.train.restore import build_simulator, restore
from tests.cli.test_commands import call, work  # noqa: F401
from tests.effects.test_spec import saved
from tests.tiny_scenes import write_scene

pytestmark = pytest.mark.usefixtures("one_thread")


def test_plan_command_lists_effects_and_costs(capsys, work):  # noqa: F811
    scene = work / "data" / "ball" / "0000"
    code, out, _ = call(capsys, "plan", scene, work / "run")
    assert code == 0 and re.search(r"ball/0000: \d+ moving and \d+ frozen particles per step, 1 image of 32x32", out)
    assert re.search(r"^history +switch +2 steps$", out, re.MULTILINE)
    assert re.search(r"^rgb +output +image$", out, re.MULTILINE) and not re.search("^depth", out, re.MULTILINE)
    assert re.search(r"^parameters not needed: 0 of \d+", out, re.MULTILINE) and "the checkpoint's" in out
    assert re.search(r"^dynamics +\d+\.\d +\d+\.\d +1\.00$", out, re.MULTILINE)


def test_plan_command_reads_spec_of_scene(capsys, tmp_path):
    scene = write_scene(tmp_path / "set" / "ball" / "0000")
    EffectsSpec(DynamicsEffects("masked_out", 1), AppearanceEffects(0)).save(tmp_path / "set" / "effects.yaml")
    code, out, _ = call(capsys, "plan", scene)
    assert code == 0 and "preset tiny, untrained, point transformer; effects: the scene's own" in out
    assert not re.search("^(history|background|view_dependent) ", out, re.MULTILINE)
    share = float(re.search(r"^dynamics .* (\d\.\d\d)$", out, re.MULTILINE)[1])
    assert share < 0.5
    file = tmp_path / "mine.yaml"
    file.write_text("appearance: {frozen_appearance: [moving, {which: frozen, box: [[0, 0, 0], [1, 1, 1]]}]}")
    code, out, _ = call(capsys, "plan", scene, "--effects", file)
    assert code == 0 and f"effects: {file}, {EffectsSpec.load(file).hash}" in out
    assert re.search(r"^frozen_appearance +switch +selections: 2$", out, re.MULTILINE)
    (scene / "effects.yaml").write_text("dynamics: {history: 9}")
    code, out, err = call(capsys, "plan", scene)
    assert code == 2 and "unsupported effect dynamics.history: this model supports at most 2; got 9" in err


def test_plan_command_reports_background_cost(capsys, tmp_path):
    scene, tiny = write_scene(tmp_path / "ball" / "0000"), presets.tiny()
    model = dataclasses.replace(tiny, dynamics=dataclasses.replace(tiny.dynamics, background="asymmetric"))
    run = saved(tmp_path / "run", EffectsSpec(), build_simulator(model, 0).state_dict(), model)
    code, out, err = call(capsys, "plan", scene, run)
    assert code == 0, err
    assert re.search(r"^background +switch +computed once a rollout$", out, re.MULTILINE)
    assert float(re.search(r"^background, once per rollout: (\d+\.\d)$", out, re.MULTILINE)[1]) > 0


def test_plan_command_predicts_milliseconds(capsys, work):  # noqa: F811
    scene, run = work / "data" / "ball" / "0000", work / "run"
    code, before, _ = call(capsys, "plan", scene, run)
    assert code == 0 and "milliseconds" not in before
    restored = restore(run)
    times = PartTimes("a clock", workload(restored.open_scene(scene), restored.data), 8.0, 4.0, 2.0)
    autotune.save_speeds(run, restored, {}, times)
    code, out, _ = call(capsys, "plan", scene, run)
    (run / autotune.SPEEDS_FILE).unlink()
    assert code == 0 and out.startswith(before)
    assert "predicted milliseconds on cpu, scaled from gsim3d profile's measurement (a clock)\n" in out
    table = re.findall(r"^(\w+) +(\d+\.\d) +\d+\.\d +\d\.\d\d$", out[len(before) :], re.MULTILINE)
    assert table == [("dynamics", "8.0"), ("gaussians", "4.0"), ("images", "2.0"), ("all", "14.0")]


def test_infer_command_writes_smallest_spec(capsys, work, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr("time.perf_counter", map(float, itertools.count()).__next__)  # all settings are equally fast
    scene, out_file = work / "data" / "ball" / "0000", tmp_path / "effects.yaml"
    code, out, _ = call(capsys, "effects", "infer", scene, work / "run", "--tolerance", "100dB", "--out", out_file)
    assert code == 0
    for row in (
        "history +1 step ",
        "changing +none ",
        "changing +dynamic ",
        "background +masked",
    ):
        assert re.search(rf"^{row}.* [+-]\d+\.\d{{3}} +[+-]\d+\.\d", out, re.MULTILINE), row
    smallest = EffectsSpec(DynamicsEffects("masked_out", 1), AppearanceEffects(changing="none"))
    assert EffectsSpec.load(out_file) == smallest, "everything may be lost"
    code, _, err = call(capsys, "effects", "infer", scene, work / "run", "--out", out_file)
    assert code == 2 and "effects.yaml exists already" in err
    code, out, _ = call(capsys, "effects", "infer", scene, work / "run", "--tolerance", "0.1dB")
    (scene / "effects.yaml").unlink()
    assert code == 0
    first = re.match(
        r"ball/0000: (\d+\.\d\d) dB with the checkpoint's effects, (\d+\.\d\d) dB with constant particles", out
    )
    proposed = re.search(r"^proposed: (\d+\.\d\d) dB \(([+-]\d+\.\d+)\)", out, re.MULTILINE)
    assert abs(float(first[2]) - float(first[1])) < 3, "an untrained model hardly moves anything"
    assert float(proposed[2]) >= -0.1 and float(proposed[1]) - float(first[1]) == pytest.approx(
        float(proposed[2]), abs=0.02
    )
    assert out.endswith("  version: 1\n")


def test_propose_puts_back_most_valuable_effect():
    """A measure that loses 0.05 dB for each of three effects, and 0.5 dB for the fourth."""
    model, base = presets.paper_latent(2), EffectsSpec()

    def trial(spec):
        history, degree = spec.dynamics.history or 2, spec.appearance.view_dependent
        lost = 0.05 * (history < 2) + 0.04 * (0 if degree is None else 3 - degree)
        lost += 0.03 * (spec.appearance.changing != "all") + 0.5 * (spec.dynamics.background != "frozen")
        return 30 - lost, 1.0

    rows, spec, (psnr, _) = propose(base, smaller_settings(base, model), trial, (30.0, 1.0), 0.1)
    assert spec == EffectsSpec(DynamicsEffects(history=1), AppearanceEffects(changing="none"))
    assert psnr == pytest.approx(30 - 0.08)
    notes = {(effect, setting): (worth, note) for effect, setting, worth, _, note in rows}
    assert notes["background", "masked out"] == ("+0.500", "")
    assert notes["history", "1 step"] == ("+0.050", "proposed")
    assert notes["view_dependent", "degree 0"] == ("+0.120", "")
    assert notes["view_dependent", "degree 1"] == ("+0.080", "too much with the others")
    assert notes["changing", "none"] == ("+0.030", "proposed")


def test_propose_measures_no_specification_twice():
    model, base, seen = presets.paper_latent(2), EffectsSpec(), []

    def trial(spec):
        seen.append(spec)
        return 30.0 - (spec.dynamics.history != 1), 1.0  # one step alone is as good

    _, spec, _ = propose(base, smaller_settings(base, model), trial, (30.0, 1.0), 0.1)
    assert spec.dynamics.history == 1
    assert base not in seen and all(seen.count(spec) == 1 for spec in seen)


def timed(cost):
    """Proposes from presets.paper_latent where a spec takes ``cost`` (spec) seconds and all are as good."""
    model, base = presets.paper_latent(2), EffectsSpec()
    rows, spec, measured = propose(
        base, smaller_settings(base, model), lambda spec: (30.0, cost(spec)), (30.0, 1.0), 0.1
    )
    return {(effect, setting): note for effect, setting, _, _, note in rows}, spec, measured


def test_propose_skips_slower_settings():
    base = EffectsSpec()
    notes, spec, measured = timed(lambda spec: 1.16)
    assert spec == base and measured == (30.0, 1.0) and set(notes.values()) == {"slower"}
    notes, spec, (_, time) = timed(lambda spec: 0.9 if spec.dynamics.history == 1 else 1.01)
    assert spec == EffectsSpec(DynamicsEffects(history=1)) and time == 0.9
    assert notes["history", "1 step"] == "proposed" and notes["background", "masked out"] == "slower"


def test_propose_separates_settings_slower_together():
    """Each alone saves time; with a history of one step all others cost more."""

    def cost(spec):
        short = spec.dynamics.history == 1
        others = spec.appearance != AppearanceEffects() or spec.dynamics.background != "frozen"
        return 1.2 if short and others else 0.99 if short else 0.9 if others else 1.0

    notes, spec, (_, time) = timed(cost)
    assert time == 0.9 and spec.dynamics.history is None and spec.dynamics.background == "masked_out"
    assert notes["history", "1 step"] == "slower with the others"


@pytest.mark.parametrize("text", ["loud", "-1", "nandB", "inf"])
def test_infer_command_refuses_invalid_tolerance(capsys, work, text):  # noqa: F811
    arguments = ["infer", work / "data" / "ball" / "0000", work / "run", f"--tolerance={text}"]
    code, _, err = call(capsys, "effects", *arguments)
    assert code == 2 and f"--tolerance: must be a number of dB of at least 0, such as 0.1dB; got '{text}'" in err


def test_simulate_command_applies_edits(capsys, work, tmp_path):  # noqa: F811
    (tmp_path / "edits.yaml").write_text(f"""
        - {{step: 1, op: remove, of: frozen}}
        - {{step: 2, op: recolor, color: [1, 0, 0]}}
        - {{step: 2, op: insert, scene: {work / "data" / "ball" / "0001"}, by: [0.2, 0, 0]}}
        """)
    scene, options = work / "data" / "ball" / "0000", ["--steps", "3", "--cameras", "3"]
    code, _, err = call(capsys, "simulate", work / "run", scene, *options, "--out", tmp_path / "plain")
    assert code == 0, err
    options += ["--edit", tmp_path / "edits.yaml"]
    code, _, err = call(capsys, "simulate", work / "run", scene, *options, "--out", tmp_path / "edited")
    assert code == 0, err
    plain, edited = (
        [read_ply(tmp_path / folder / "gaussians" / f"step_{i:04d}.ply").means.shape[0] for i in range(5)]
        for folder in ("plain", "edited")
    )
    assert edited[:3] == plain[:3] and edited[3] < plain[3] and edited[4] > edited[3]


def test_simulate_command_applies_effects_file(capsys, work, tmp_path):  # noqa: F811
    EffectsSpec(DynamicsEffects("masked_out")).save(tmp_path / "spec.yaml")
    scene, options = work / "data" / "ball" / "0000", ["--steps", "1", "--cameras", "3"]
    masked = ["--effects", tmp_path / "spec.yaml"]
    for out, more in (("plain", []), ("masked", masked)):
        code, _, err = call(capsys, "simulate", work / "run", scene, *options, *more, "--out", tmp_path / out)
        assert code == 0, err
    plain, masked = (read_ply(tmp_path / out / "gaussians" / "step_0002.ply") for out in ("plain", "masked"))
    assert 0 < masked.means.shape[0] < plain.means.shape[0]


def test_simulate_command_reports_resting_share(capsys, work, tmp_path):  # noqa: F811
    scene, file = work / "data" / "ball" / "0000", tmp_path / "effects.yaml"
    file.write_text("dynamics: {sleep: {eps: 1000000.0, patience: 2}}")
    options = ["--steps", "4", "--cameras", "0", "--effects", file, "--out", tmp_path / "out"]
    code, out, err = call(capsys, "simulate", work / "run", scene, *options)
    assert code == 0, err
    assert "4 predicted (50% of the particles at rest, not computed)" in out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- {step: 9, op: remove, of: frozen}", "edit at step 9, remove: the rollout has steps 0 to 1"),
        ("- {step: 0, op: fly}", "edit 0 at step 0: op must be one of remove, move"),
        ("- {step: 0, op: insert, scene: nowhere}", "edit 0 at step 0, insert: "),
    ],
)
def test_simulate_command_refuses_invalid_edits(capsys, work, tmp_path, text, message):  # noqa: F811
    (tmp_path / "edits.yaml").write_text(text)
    options = ["--steps", "2", "--edit", tmp_path / "edits.yaml", "--out", tmp_path / "out"]
    code, _, err = call(capsys, "simulate", work / "run", work / "data" / "ball" / "0000", *options)
    assert code == 2 and message in err and err.count("\n") == 1 and not (tmp_path / "out").exists()
