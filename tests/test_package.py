"""The package as a whole: one version, lazy names, kernels without torch, and what pip makes of it."""

import os
import platform
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
import setuptools
import torch
from torch.utils import cpp_extension

import gsim3d
from gsim3d.errors import X86_64_V3, check_processor

ROOT = Path(__file__).parent.parent


def test_one_version():
    header = (ROOT / "csrc" / "gsim3d" / "core" / "version.h").read_text()
    assert re.search(r'GSIM3D_VERSION "(.+)"', header).group(1) == gsim3d.__version__
    assert f"## [{gsim3d.__version__}] - " in (ROOT / "CHANGELOG.md").read_text()
    assert f"version: {gsim3d.__version__}\n" in (ROOT / "CITATION.cff").read_text()


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


@pytest.mark.parametrize("missing", sorted(X86_64_V3))
@pytest.mark.skipif(platform.machine() != "x86_64", reason="other processors have no levels")
def test_an_older_processor_is_refused_at_import(missing, tmp_path):
    place = tmp_path / "cpuinfo"
    place.write_text(f"processor\t: 0\nflags\t\t: fpu sse4_2 {' '.join(X86_64_V3)}\n")
    check_processor(place)
    place.write_text(f"processor\t: 0\nflags\t\t: fpu sse4_2 {' '.join(X86_64_V3 - {missing})}\n")
    with pytest.raises(gsim3d.ProcessorError, match=rf"x86-64-v3 .* lacks {missing}$"):
        check_processor(place)


OLD_PROCESSOR = """
import builtins, io
real = open
builtins.open = lambda file, *a, **k: io.StringIO("flags : fpu") if "cpuinfo" in str(file) else real(file, *a, **k)
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="other processors have no levels")
@pytest.mark.parametrize("statement", ["import gsim3d", "from gsim3d import _core", "import gsim3d.ops"])
def test_every_import_checks_the_processor(statement):
    code = OLD_PROCESSOR + statement
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("gsim3d.errors.ProcessorError: gsim3d needs an x86-64-v3")


def test_processors_without_a_list_of_instructions_pass(tmp_path):
    check_processor(tmp_path / "none")
    (tmp_path / "empty").write_text("processor : 0\n")
    check_processor(tmp_path / "empty")


@pytest.mark.parametrize(
    ("choice", "torch_cuda", "toolkit", "gpus", "cuda"),
    [
        ("", "13.0", "/usr/local/cuda", 0, False),
        ("", "13.0", "/usr/local/cuda", 1, True),
        ("", "13.0", None, 1, False),
        ("", None, "/usr/local/cuda", 0, False),
        ("0", "13.0", "/usr/local/cuda", 1, False),
        ("1", "13.0", "/usr/local/cuda", 0, True),
        ("1", "13.0", None, 1, "GSIM3D_CUDA=1, but"),
        ("1", None, "/usr/local/cuda", 0, "GSIM3D_CUDA=1, but"),
        ("yes", "13.0", "/usr/local/cuda", 1, "GSIM3D_CUDA must be 0 or 1; got 'yes'"),
    ],
)
def test_cuda_is_built_for_a_visible_gpu_or_on_request(choice, torch_cuda, toolkit, gpus, cuda, monkeypatch):
    monkeypatch.setattr(setuptools, "setup", lambda **options: None)
    monkeypatch.setenv("GSIM3D_CUDA", "0")
    wants_cuda = runpy.run_path(str(ROOT / "setup.py"))["wants_cuda"]
    monkeypatch.setenv("GSIM3D_CUDA", choice)
    monkeypatch.setattr(torch.version, "cuda", torch_cuda)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(cpp_extension, "CUDA_HOME", toolkit)
    if isinstance(cuda, str):
        with pytest.raises(SystemExit, match=cuda):
            wants_cuda()
    else:
        assert wants_cuda() is cuda


def python(*command, cwd, **environment):
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, cwd=cwd, env={**os.environ, **environment}
    )
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """Made of the files that a clone has, so that nothing built before gets in."""
    place = tmp_path_factory.mktemp("sdist")
    ignored = shutil.ignore_patterns(".*", "__pycache__", "*.so", "*.egg-info", "build", "runs", "demo", "docs")
    shutil.copytree(ROOT, place / "clone", ignore=ignored)
    make = f"from setuptools.build_meta import build_sdist; print(build_sdist({str(place)!r}))"
    name = python(sys.executable, "-c", make, cwd=place / "clone").splitlines()[-1]
    return place / name


def test_sdist_holds_all_that_a_build_reads(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    sources = [path for folder in ("csrc", "gsim3d") for path in (ROOT / folder).rglob("*") if path.is_file()]
    wanted = {str(path.relative_to(ROOT)) for path in sources if path.suffix not in (".so", ".pyc")}
    assert len(wanted) > 300 and wanted <= names
    assert {"setup.py", "pyproject.toml", "CMakeLists.txt", "LICENSE", "README.md"} <= names
    assert not [name for name in names if name.endswith((".so", ".o", ".pyc"))]


@pytest.mark.slow
def test_sdist_becomes_a_wheel_that_predicts_without_a_compiler(sdist, tmp_path):
    pip = [sys.executable, "-m", "pip"]
    offline = ["--quiet", "--no-index", "--no-deps"]
    python(*pip, "wheel", *offline, "--no-build-isolation", "-w", tmp_path, sdist, cwd=tmp_path, GSIM3D_CUDA="0")
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {"gsim3d/py.typed", "gsim3d/evaluate/ablations.yaml"} <= set(names)
    assert len([name for name in names if name.endswith(".so")]) == 2
    # A new environment that has the dependencies of this one, but not its gsim3d: .pth files in there are not read.
    venv.create(tmp_path / "env", with_pip=False)
    fresh = tmp_path / "env" / "bin" / "python"
    python(*pip, "--python", fresh, "install", *offline, wheel, cwd=tmp_path)
    site = next((tmp_path / "env").glob("lib/python*/site-packages"))
    (site / "dependencies.pth").write_text("\n".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}))
    command = [fresh, "-I", "-m", "gsim3d"]
    script = (ROOT / "tools" / "build_wheels.sh").read_text()
    tried = re.findall(r'"\$\{gsim3d\[@\]\}" (.*)', script)
    assert [words.split()[0] for words in tried] == ["doctor", "generate", "simulate"]
    for words in tried:
        python(*command, *words.split(), cwd=tmp_path, PATH="")
    assert (tmp_path / "predicted" / "rollout.mp4").stat().st_size > 1000
    assert str(site) in python(fresh, "-I", "-c", "import gsim3d.ops; print(gsim3d.__file__)", cwd=tmp_path)


def test_wheels_are_built_for_pythons_that_are_known():
    script, environment = ROOT / "tools" / "build_wheels.sh", {**os.environ, "PYTHONS": "false"}
    done = subprocess.run(["bash", script], capture_output=True, text=True, env=environment)
    assert done.returncode == 1 and "PYTHONS: false is no Python 3.11, 3.12 or 3.13" in done.stderr
