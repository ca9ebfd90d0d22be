"""tools/release/trust.py: counts of announced inputs, undeclared lenses, and the figure and page of its results."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gsim3d import presets
from gsim3d.evaluate import trust
from gsim3d.io.checkpoint import Checkpoint, export
from gsim3d.io.settings import to_dict
from gsim3d.numerics.trust import Trust
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import build_simulator, restore
from tests.tiny_scenes import write_scene
from tools.release import trust as tool
from tools.release.trust import declare_lens, detection, draw


def test_counts_of_announced_inputs():
    ranges = {"near depth [m]": (1.0, 0.1), "ground red": (0.5, 0.1)}
    made = Trust(2, 3, 0.5, 1.0, (0.0,), (0.9,), ((0.1,),), ranges, 3.0)
    found = detection(made, [{"near depth [m]": 1.1, "ground red": 0.6}, {"near depth [m]": 5.0, "ground red": 1.0}])
    assert found == {"scenes": 2, "announced": 1, "measures": {"near depth": 1, "ground red": 1}}


def test_declared_lens(tmp_path):
    folder = write_scene(tmp_path / "0000", size=32)
    declare_lens([folder], 90.0)
    assert json.loads((folder / "metadata.json").read_text())["cam_3"]["intrinsics"][1][1] == pytest.approx(16)


def test_figure_and_page(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(0)
    pairs = [(spread := np.exp(rng.normal(-5, 1, (4, 50))), spread * np.exp(rng.normal(0, 0.3, spread.shape)))]
    made = Trust(n_scenes=1, n_steps=4, ranges={}, threshold=3.0, **trust.fit_bounds(pairs))
    sets = {name: trust.report(made, pairs) for name in ("validation", "test")}
    results = {"sets": sets, "detection": {"test": {"scenes": 4, "announced": 1, "measures": {"near depth": 1}}}}
    results["detection"] |= {f"size, {n}": {"scenes": 3, "announced": n, "measures": {}} for n in (1, 2)}
    draw(tmp_path / "trust.png", results, made, {"test": pairs})
    assert (tmp_path / "trust.png").stat().st_size > 10_000
    (tmp_path / "elastic-small.trust.json").write_text(json.dumps(results))
    spec = importlib.util.spec_from_file_location("generate", Path(__file__).parents[2] / "docs" / "generate.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    monkeypatch.setattr(pages, "RESULTS", tmp_path)
    page = pages.trust()
    assert "| test | 4 | 1 | near depth (1) |" in page and "| validation, within steps | 1 | 200 |" in page
    assert "| test | 1 of 4 | 25% | 5% to 70% |" in page and pages.wilson(6, 8) == pytest.approx(
        (0.4093, 0.9285), abs=1e-4
    )
    assert "| size | 3 of 6 | 50% |" in page and "±" not in page
    sets["test"] = trust.report(made, pairs * 2)
    (tmp_path / "elastic-small.trust.json").write_text(json.dumps(results))
    assert pages.trust().count("% ± ") == 2


def test_any_weights_are_calibrated_and_go_on_with_their_own(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    few = {"image_size": 32, "n_cams": 4, "objects": ("ball",)}
    monkeypatch.setattr(tool, "FRAMES", 6)
    monkeypatch.setattr(tool, "STEPS", 3)
    monkeypatch.setattr(tool, "CHANGED", 1)
    monkeypatch.setattr(
        tool, "SETS", {name: (1, 1, {"seed": 77 + k, **few}) for k, name in enumerate(["validation", "test"])}
    )
    monkeypatch.setattr(tool, "CHANGES", {"lens, wider": {"fov": 50.0, **few}})
    data = {**to_dict(DataConfig(history=2, context_views=2, target_only_cameras=(3,))), "image_size": [32, 32]}
    for seed in (0, 1):
        simulator = build_simulator(presets.tiny(), seed=seed)
        torch.nn.init.normal_(simulator.dynamics.net.head.fc2.weight, 0, 0.02)
        saved = Checkpoint(
            simulator.state_dict(), config={"model": to_dict(presets.tiny()), "data": data}, state={"step": 1}
        )
        export(saved, tmp_path / f"{seed}.safetensors")
        given = ["elastic-tiny", "--checkpoint", str(tmp_path / f"{seed}.safetensors"), "--preset", "mini"]
        given += ["--data", str(tmp_path / "data"), "--out", str(tmp_path)]
        tool.main(given)
        assert restore(tmp_path / f"{seed}.safetensors").simulator.trust.n_scenes == 1
        assert "lens, wider: 1 of 1 announced" in (said := capsys.readouterr().out)
    found = json.loads((tmp_path / "trust.json").read_text()).values()
    assert len(found) == 2 and len({tuple(one["bounds"][0]) for one in found}) == 2
    monkeypatch.setattr(tool, "predict_together", None)  # all is kept
    monkeypatch.setattr(trust, "measure_scene", None)
    tool.main(given)
    assert capsys.readouterr().out == said and (tmp_path / "elastic-tiny.trust.png").is_file()
