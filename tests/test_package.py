"""The package as a whole: one version, lazy names, kernels without torch."""

import re
import subprocess
import sys
from pathlib import Path

import gsim3d

ROOT = Path(__file__).parent.parent


def test_one_version():
    header = (ROOT / "csrc" / "gsim3d" / "core" / "version.h").read_text()
    assert re.search(r'GSIM3D_VERSION "(.+)"', header).group(1) == gsim3d.__version__
    assert f"## {gsim3d.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_public_names_load():
    for name in gsim3d.__all__:
        assert getattr(gsim3d, name) is not None
    assert set(gsim3d.__all__) <= set(dir(gsim3d))


def test_core_needs_no_torch():
    code = (
        "import sys, numpy as np\n"
        "from gsim3d import _core\n"
        "out, argmax = _core.pool_max(np.float32([[1, 4], [3, 2]]), [0, 1], [0, 2])\n"
        "assert out.tolist() == [[3, 4]] and argmax.tolist() == [[1, 0]]\n"
        "assert 'torch' not in sys.modules\n"
        "try: _core.pool_mean(np.float32([[1]]), [3], [0, 1])\n"
        "except ValueError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "pool_mean: rows must be in [0, N) with N=1; got 3 at 0" in done.stdout
