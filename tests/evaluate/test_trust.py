"""Trust: spread of variants, calibrated bounds of errors, and inputs that are announced as unfamiliar."""

import dataclasses
import json
import warnings

import numpy as np
import pytest
import torch

from gsim3d import presets
from gsim3d.cli.main import main
from gsim3d.errors import InputError, UnfamiliarInput
from gsim3d.evaluate import job, trust as calibration
from gsim3d.evaluate.protocol import default_views, input_frames, predict, predict_together
from gsim3d.io.checkpoint import Checkpoint, export
from gsim3d.io.settings import to_dict
from gsim3d.numerics import trust
from gsim3d.numerics.speed import encode_histories
from gsim3d.numerics.trust import VARIANTS, Trust
from gsim3d.state import DYNAMIC, concatenate, last_steps
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import build_simulator, restore
from tests.tiny_scenes import write_scene

pytestmark = pytest.mark.usefixtures("one_thread")
RADIUS = 0.3


def write_states(folder):
    """A tiny scene whose ball has a lattice of nodes as the generator writes it."""
    write_scene(folder, seed=int(folder.name))
    height = np.random.default_rng(int(folder.name)).uniform(0.3, 1, 4)[3] * 0.2 + 0.8
    steps = np.maximum(0.3, height - 0.02 * np.arange(6) ** 2)
    corners = RADIUS * (2.0 * np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1) - 1)
    np.savez(folder / "states.npz", body_0=(corners + steps[:, None, None, None, None] * [0, 0, 1]).astype(np.float32))
    return folder


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A tiny model that moves things, as a file, and three scenes with states."""
    root = tmp_path_factory.mktemp("trust")
    simulator = build_simulator(presets.tiny(), seed=0)
    with torch.no_grad():
        simulator.dynamics.net.head.fc2.weight.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    data = {**to_dict(DataConfig(history=2, context_views=2, target_only_cameras=(3,))), "image_size": [32, 32]}
    content = {"model": to_dict(presets.tiny()), "data": data}
    export(Checkpoint(model=simulator.state_dict(), config=content, state={"step": 1}), root / "model.safetensors")
    for name in ("0000", "0001", "0002"):
        write_states(root / "data" / "ball" / name)
    return root


@pytest.fixture
def restored(work):
    return restore(work / "model.safetensors")


@pytest.fixture
def scenes(work, restored):
    return [restored.open_scene(folder) for folder in sorted((work / "data" / "ball").iterdir())]


def made_trust(**changes):
    fields = {
        "n_scenes": 2, "n_steps": 3, "spread_power": 0.5, "step_power": 1.0, "scores": (-5.0, 0.0),
        "levels": (0.5, 0.9), "bounds": ((0.01, 0.02), (0.02, 0.08)), "ranges": {}, "threshold": 3.0,
    }  # fmt: skip
    return Trust(**{**fields, **changes})


def test_batched_spread_is_that_of_a_loop_over_variants(restored, scenes):
    simulator, context = restored.simulator, [default_views(restored, scene)[0] for scene in scenes[:2]]
    with torch.no_grad():
        histories = encode_histories(simulator, input_frames(restored, scenes[:2], context))
        steps, spread = trust.rollout_with_spread(simulator, histories, 3, restored.plan)
        for b in range(2):
            paths = []
            for left_out, cells in VARIANTS:
                state = histories[left_out]
                state = state.select_clouds([q for q, scene in enumerate(state.clouds.scenes) if scene == b])
                state = dataclasses.replace(state, cloud_scene=state.cloud_scene * 0, origin=state.origin[b : b + 1])
                shift = simulator.config.dynamics.grid_size * torch.tensor(cells, dtype=torch.float64)

                def geometry(history, shift=shift):
                    return simulator.dynamics.geometry(dataclasses.replace(history, origin=history.origin - shift))

                alone = simulator.rollout(state, 3, restored.plan, geometry=geometry)
                paths.append(torch.stack([step.means for step in alone]))
            paths = torch.stack(paths)
            expected = (paths - paths.mean(0)).square().sum(-1).mean(0).sqrt()
            rows = [(step.row_scene() == b) for step in steps]
            torch.testing.assert_close(spread[:, rows[0]], expected, rtol=1e-3, atol=1e-6)
            torch.testing.assert_close(torch.stack([s.means[r] for s, r in zip(steps, rows)]), paths[0])
            assert expected.max() > 1e-5


def test_the_prediction_with_spread_is_the_prediction(restored, scenes):
    scene, counted = scenes[0], []
    context = default_views(restored, scene)[0]
    plain = predict(restored, scene, context, 3)
    first, second = (predict(restored, scene, context, 3, with_spread=True, on_steps=counted.append) for _ in range(2))
    torch.testing.assert_close(first.particles.means, plain.particles.means, rtol=0, atol=1e-6)
    assert torch.equal(first.spread, second.spread) and counted == [1] * 6
    assert first.spread.shape == (3, plain.step(2).n_rows)
    with pytest.raises(InputError, match="edits: the spread"):
        predict(restored, scene, context, 3, edits=[object()], with_spread=True)


def test_oldest_steps_are_left_out(restored, scenes):
    restored.simulator.inputs = dataclasses.replace(restored.simulator.inputs, history=4)
    frames = input_frames(restored, scenes[:2], [[0, 2]] * 2)
    for n_steps, left in ((0, 4), (1, 3), (2, 2), (3, 2)):
        kept = trust.without_oldest(frames, n_steps)
        assert kept.cloud_step.tolist() == list(range(4 - left, 4)) * 2 and len(kept.images) == 4 * left
        assert kept.cameras.image_cloud.tolist() == [cloud for cloud in range(2 * left) for _ in range(2)]
        assert torch.equal(kept.images[-2:], frames.images[-2:])


def test_bounds_rise_and_hold_for_their_share():
    rng = np.random.default_rng(0)
    spread = np.exp(rng.normal(-5, 1, (12, 4000)))
    error = spread * np.arange(1, 13)[:, None] ** 0.5 * np.exp(rng.normal(0, 0.5, spread.shape))
    fields = calibration.fit_bounds([(spread, error)])
    made = made_trust(**fields)
    assert made.spread_power == pytest.approx(1, abs=0.1) and made.step_power == pytest.approx(0.5, abs=0.1)
    found = calibration.report(made, [(spread, error)])
    assert all(share == pytest.approx(float(level), abs=0.02) for level, share in found["reliability"].items())
    assert found["risk_coverage"]["perfect"] < found["risk_coverage"]["trust"] < 0.8 * found["risk_coverage"]["step"]
    assert found["within_steps"]["step"] == pytest.approx(error.mean())
    assert found["within_steps"]["perfect"] < found["within_steps"]["trust"] < 0.8 * error.mean()
    rising = torch.logspace(-6, 0, 50, dtype=torch.float64).expand(5, 50)
    bounds = torch.stack([made.bound(rising, level) for level in made.levels])
    assert all((bounds.diff(dim=axis) >= 0).all() for axis in range(3))
    with pytest.raises(InputError, match="level must be one of 0.1"):
        made.bound(rising, 0.77)


def test_the_error_over_scenes_is_that_of_a_jackknife():
    rng = np.random.default_rng(1)
    spreads = [np.exp(rng.normal(-5, 1, (4, 30))) for _ in range(3)]
    pairs = [(spread, spread * rng.exponential(size=(4, 30))) for spread in spreads]
    made = made_trust(**calibration.fit_bounds(pairs))
    found = calibration.report(made, pairs)
    for key, error in found["ratio_error"].items():
        parts = [calibration.report(made, pairs[:n] + pairs[n + 1 :])[key] for n in range(3)]
        ratios = np.array([part["trust"] / part["step"] for part in parts])
        assert error == pytest.approx(np.sqrt(2 / 3 * ((ratios - ratios.mean()) ** 2).sum())) and error > 0
    assert calibration.table(found).count(" ± ") == 2 and calibration.report(made, pairs[:1])["ratio_error"] == {}


def test_bounds_hold_where_scores_are_equal():
    rng = np.random.default_rng(0)
    spread, step = np.zeros((8, 500)), np.arange(1, 9)[:, None]
    pairs = [
        (spread, size * step * rng.exponential(size=spread.shape)) for size in (0.01, 0.1)
    ]  # an easy, a hard scene
    fields = calibration.fit_bounds(pairs)
    assert list(fields["scores"]) == sorted(set(fields["scores"])) and len(fields["scores"]) == 8
    found = calibration.report(made_trust(**fields), pairs)["reliability"]
    assert all(share == pytest.approx(float(level), abs=0.005) for level, share in found.items())


def test_powers_are_never_negative():
    rng = np.random.default_rng(0)
    spread = np.exp(rng.normal(-5, 1, (8, 500)))
    found = calibration.fit_bounds([(spread, 1 / spread)])
    assert found["spread_power"] == 0 and found["step_power"] >= 0
    step, noise = np.arange(1, 9)[:, None], rng.normal(0, 0.3, spread.shape)
    found = calibration.fit_bounds([(step * np.exp(noise), step**2 * np.exp(-noise / 2))])  # less spread, larger errors
    assert found["spread_power"] == 0 and found["step_power"] == pytest.approx(2, abs=0.05)
    assert calibration.rising([1, 3, 2, 4]) == [1, 2.5, 2.5, 4]


def test_risk_coverage():
    errors = np.random.default_rng(0).exponential(size=500)
    perfect, mean = calibration.risk_coverage(errors, errors), errors.mean()
    assert perfect < calibration.risk_coverage(errors, np.arange(500)) < calibration.risk_coverage(errors, -errors)
    assert calibration.risk_coverage(errors, np.zeros(500)) == pytest.approx(mean)  # no order: no gain
    assert calibration.risk_coverage(np.array([1.0, 3.0]), np.array([0, 1])) == pytest.approx(1.5)


def test_one_percent_of_the_calibration_is_out_of_range():
    rng = np.random.default_rng(0)
    measured = [{"a": rng.normal(), "b": rng.normal(5, 0.1), "fixed": 42.0} for _ in range(400)]
    made = made_trust(**calibration.fit_ranges(measured))
    assert sum(bool(made.unfamiliar(one)) for one in measured) <= 4
    assert made.unfamiliar({"a": 0.0, "b": 5.0, "fixed": 42.1}) == []
    (said,) = made.unfamiliar({"a": 0.0, "b": 5.0, "fixed": 50.0})
    assert said.startswith("fixed 50 (validated: 4") and "missing" not in said
    assert "no a (validated" in made.unfamiliar({"b": 5.0, "fixed": 42.0})[0]


def test_true_motion_has_no_error_and_shifts_have_theirs(restored, scenes):
    (made,) = predict_together(restored, scenes[:1], 3, with_spread=True)
    states = np.load(scenes[0].path / "states.npz")["body_0"][:, 0, 0, 0].astype(float)
    steps = [made.step(1)]
    for k in range(3):
        moved = torch.from_numpy(states[2 + k] - states[1] + [0.05 * k, 0, 0]).float()
        steps.append(dataclasses.replace(steps[0], means=steps[0].means + moved, cloud_step=torch.tensor([2 + k])))
    true = dataclasses.replace(made, particles=concatenate([made.step(0), *steps]))
    spread, error = calibration.samples(scenes[0], true)
    assert spread.shape == error.shape == (3, int((steps[0].activity == DYNAMIC).sum()))
    np.testing.assert_allclose(error, np.array([[0], [0.05], [0.1]]) * np.ones_like(error), atol=1e-5)


def test_a_changed_rig_is_announced(restored, scenes, work, tmp_path):
    measured = [calibration.measure_scene(restored, scene) for scene in scenes]
    restored.simulator.trust = made_trust(**calibration.fit_ranges(measured))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInput)
        calibration.measure_scene(restored, scenes[0])
    folder = write_states(tmp_path / "0000")
    file = folder / "metadata.json"
    metadata = json.loads(file.read_text())
    for cam in range(metadata["n_cams"]):
        for axis in (0, 1):
            metadata[f"cam_{cam}"]["intrinsics"][axis][axis] *= 1.3
    file.write_text(json.dumps(metadata))
    changed = restored.open_scene(folder)
    with pytest.warns(UnfamiliarInput, match=r"0000: .*field of view \[degrees\] 32\.96 \(validated: 3\d"):
        predict(restored, changed, default_views(restored, changed)[0], 1)
    with pytest.warns(UnfamiliarInput, match="scene 0: .*field of view"):
        restored.simulator.predict(changed, 1)


def test_heights_are_those_of_the_files(restored, scenes, tmp_path):
    """A scene far from 0 along x is measured as the same scene near it, also where its coordinates count from above."""
    here = calibration.measure_scene(restored, scenes[0])
    folder = write_states(tmp_path / "0000")
    file = folder / "metadata.json"
    metadata = json.loads(file.read_text())
    for cam in range(metadata["n_cams"]):
        viewmat = np.array(metadata[f"cam_{cam}"]["extrinsics"])
        viewmat[:3, 3] -= viewmat[:3, :3] @ [3000.0, 0, 0]
        metadata[f"cam_{cam}"]["extrinsics"] = viewmat.tolist()
    file.write_text(json.dumps(metadata))
    far = restored.open_scene(folder)
    there = calibration.measure_scene(restored, far)
    assert far.world_offset[0] and far.world_offset[2] and there.keys() == here.keys()
    for name in ("camera height [m]", "ground height [m]", "body radius [m]"):
        assert there[name] == pytest.approx(here[name], abs=2e-3), name


def test_verdict(restored, scenes):
    made = predict_together(restored, scenes[:1], 2, with_spread=True)[0]
    particles = last_steps(made.particles, 1)
    bounds = torch.tensor([0.01, 0.03])[:, None].expand(2, particles.n_rows)
    assert "exceeds 0.02 m from predicted step 2 on (0.03 m)" in made_trust().verdict(bounds, particles, 0.02)
    assert "stays within 0.5 m for all 2 predicted steps" in made_trust().verdict(bounds, particles, 0.5)
    assert "steps after 1 are beyond the calibration" in made_trust(n_steps=1).verdict(bounds, particles, 0.5)


def test_what_trust_needs_is_checked_before_scoring(work, tmp_path, capsys, monkeypatch):
    model, write = work / "model.safetensors", job.score_scenes
    monkeypatch.setattr(calibration, "samples", lambda *given: None)
    monkeypatch.setattr(job, "score_scenes", None)
    calibration.save_trust(work, restore(model).checkpoint.digest, made_trust())
    write_scene(tmp_path / "data" / "ball" / "0000")
    evaluate = ["evaluate", str(model), str(tmp_path / "data"), "--scenes", "all", "--metrics", "psnr"]
    evaluate += ["--out", str(tmp_path / "report.json")]
    assert main([*evaluate, "--trust"]) == 2 and "no scene has one" in capsys.readouterr().err
    for option in ("--trust", "--calibrate-trust"):
        assert main([*evaluate, option, "--context", "0", "1"]) == 2
        assert "--context cannot be combined" in capsys.readouterr().err
    shipped = ["evaluate", "elastic-small", str(work / "data"), "--calibrate-trust"]
    assert main(shipped) == 2 and "elastic-small is of the package" in capsys.readouterr().err
    monkeypatch.setattr(job, "score_scenes", write)
    write_states(tmp_path / "data" / "ball" / "0001")
    assert main([*evaluate, "--trust"]) == 2 and "nothing moves" in capsys.readouterr().err
    assert json.loads((tmp_path / "report.json").read_text())["n_scenes"] == 2
    (work / "trust.json").unlink()


def test_commands(work, tmp_path, capsys):
    model, data = str(work / "model.safetensors"), str(work / "data")
    simulate = ["simulate", model, f"{data}/ball/0000", "--steps", "3", "--max-error", "0.000001", "--quiet"]
    assert main([*simulate, "--out", str(tmp_path / "a")]) == 2
    assert "errors are not calibrated" in (said := capsys.readouterr().err) and "--calibrate-trust" in said
    calibrate = ["evaluate", model, data, "--scenes", "all", "--calibrate-trust"]
    assert main([*calibrate, "--baselines", "spring-gaus"]) == 2
    assert "--calibrate-trust cannot be combined with" in capsys.readouterr().err
    assert main(calibrate) == 0
    made = restore(model).simulator.trust
    assert made.n_scenes == 3
    calibration.save_trust(work, restore(model).checkpoint.digest, dataclasses.replace(made, threshold=1e-9))
    capsys.readouterr()
    assert main(calibrate) == 0 and "unlike the validation scenes" not in capsys.readouterr().err
    assert restore(model).simulator.trust == made
    assert main([*simulate, "--out", str(tmp_path / "b")]) == 0
    assert "exceeds 1e-06 m from predicted step 1 on" in capsys.readouterr().out
    report = tmp_path / "report.json"
    assert main(["evaluate", model, data, "--scenes", "all", "--trust", "--metrics", "psnr", "--out", str(report)]) == 0
    assert "area under the risk-coverage curve" in capsys.readouterr().out
    found = json.loads(report.read_text())["trust"]
    assert found["n_scenes"] == 3 and len(found["by_step"]["bound"]) == 4
    (work / "trust.json").write_text("[]")
    assert main([*simulate, "--out", str(tmp_path / "c")]) == 2
    assert "trust.json must hold a mapping" in capsys.readouterr().err
    (work / "trust.json").unlink()
