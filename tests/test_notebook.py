"""The notebook is stored as executed, and runs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILE = ROOT / "examples" / "predict_look_edit_score.ipynb"
CELLS = json.loads(FILE.read_text())["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]
CHECKS = """
assert summary["future.psnr_masked"] > summary["constant.future.psnr_masked"] + 2
assert Picture(truth, images(edited))._repr_jpeg_()[:2] == b"\\xff\\xd8"
assert (images(edited)[:6] == images(prediction)[:6]).all() and (images(edited)[8] != images(prediction)[8]).any()
"""


def test_notebook_is_stored_as_executed():
    assert FILE.stat().st_size < 300_000
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert all(output["output_type"] == "execute_result" for output in outputs) and len(outputs) == len(code)
    assert sum("image/jpeg" in output["data"] for output in outputs) == 2


@pytest.mark.slow
def test_notebook_runs(tmp_path):
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    code = "\n".join([*CODE, CHECKS])
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs" / "notebook" / "player.html").is_file()
