"""tools/release/trust.py: counts of announced inputs, undeclared lenses, and the figure and page of its results."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from gsim3d.evaluate import trust
from gsim3d.numerics.trust import Trust
from tests.tiny_scenes import write_scene
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
    draw(tmp_path / "trust.png", results, made, {"test": pairs})
    assert (tmp_path / "trust.png").stat().st_size > 10_000
    (tmp_path / "trust.json").write_text(json.dumps(results))
    spec = importlib.util.spec_from_file_location("generate", Path(__file__).parents[2] / "docs" / "generate.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    monkeypatch.setattr(pages, "RESULTS", tmp_path)
    page = pages.trust()
    assert "| test | 4 | 1 | near depth (1) |" in page and "| validation, within steps | 1 | 200 |" in page
