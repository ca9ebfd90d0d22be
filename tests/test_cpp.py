"""The torch-free core: its C++ tests, and a stranger's CMake project built against the installed package."""

import os
import platform
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.io.ply import write_ply
from gsim3d.ops import rasterize_gaussians
from gsim3d.state import Gaussians

ROOT = Path(__file__).parent.parent


def run(*command):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    assert shutil.which("cmake") and shutil.which("ninja"), "the C++ tests need cmake and ninja: pip install -e .[dev]"
    folder = tmp_path_factory.mktemp("cmake")
    run("cmake", "-G", "Ninja", "-S", ROOT, "-B", folder, "-DCMAKE_BUILD_TYPE=Release")
    run("cmake", "--build", folder, "--parallel", "2")
    return folder


@pytest.fixture(scope="module")
def prefix(build, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prefix")
    run("cmake", "--install", build, "--prefix", folder)
    return folder


def check_syntax(include, text, place, *options):
    place.write_text(text)
    run("c++", "-std=c++20", "-Wall", "-Wextra", "-Werror", *options, "-I", include, "-fsyntax-only", place)


def test_core_tests_pass(build):
    output = run("ctest", "--test-dir", build, "--output-on-failure")
    assert "100% tests passed" in output
    sources = len(list((ROOT / "tests" / "cpp").glob("test_*.cpp")))
    assert f"out of {sources}" in output


def test_foreign_project_builds_against_the_install_tree(prefix, tmp_path):
    consumer = ROOT / "tests" / "cpp" / "consumer"
    run("cmake", "-G", "Ninja", "-S", consumer, "-B", tmp_path / "app", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", tmp_path / "app")
    assert run(tmp_path / "app" / "app").split() == ["3", "3"]

    render(tmp_path / "app" / "render_ply", tmp_path)


def render(program, folder):
    """The example draws what the op draws; a file that is none is refused."""
    g = torch.Generator().manual_seed(0)
    means, quats = torch.randn(200, 3, generator=g), torch.randn(200, 4, generator=g)
    scales, opacities = 0.02 + 0.1 * torch.rand(200, 3, generator=g), 0.2 + 0.7 * torch.rand(200, generator=g)
    sh = 1.7 * torch.rand(200, 1, 3, generator=g)
    write_ply(folder / "in.ply", Gaussians(means, quats, scales, opacities, sh, torch.tensor([0, 200])))
    run(program, folder / "in.ply", folder / "out.png")
    low, high = means.amin(0), means.amax(0)
    middle = (low + high) / 2
    viewmat = torch.eye(4)[None].clone()
    viewmat[0, :3, 3] = torch.stack([-middle[0], -middle[1], 2 * (high - middle)[:2].max() - low[2]])
    K = torch.tensor([[[320.0, 0, 320], [0, 320, 240], [0, 0, 1]]])
    cameras = Cameras(viewmat, K, torch.full((1,), 1e-3), torch.ones(1), torch.zeros(1, dtype=torch.int64), 640, 480)
    expected = rasterize_gaussians(means, quats, scales, opacities, cameras, sh=sh, background=torch.zeros(1, 3))
    image = cv2.imread(str(folder / "out.png"))[..., ::-1].astype(float)
    assert abs(image - 255 * expected.color[0].clamp(0, 1).numpy()).max() < 1 and image.max() > 50
    good = (folder / "in.ply").read_bytes()
    wrong = {b"binary_little_endian": b"ascii", b"float opacity": b"double opacity", b" rot_3": b" other"}
    wrong |= {
        b"element": b"comment SplatRenderMode: mip\nelement",
        b"element vertex": b"comment antialiased 1\nelement vertex",
    }
    bad = [good.replace(b"little", b"big"), *(good.replace(part, other) for part, other in wrong.items())]
    (folder / "in.ply").write_bytes(good.replace(b"element vertex", b"comment antialiased 0\nelement vertex"))
    run(program, folder / "in.ply", folder / "out.png")
    for data in (b"ply\nelement vertex 3\nend_header\n", *bad):
        (folder / "bad.ply").write_bytes(data)
        assert subprocess.run([program, folder / "bad.ply", folder / "none.png"], capture_output=True).returncode == 1


def test_installed_headers_compile_alone_and_together(prefix, tmp_path):
    include = prefix / "include"
    headers = sorted(str(path.relative_to(include)) for path in include.rglob("*.h"))
    ops = {path.name for path in (ROOT / "csrc" / "gsim3d").iterdir()} - {"torch", "numpy"}
    assert {header.split("/")[1] for header in headers} == ops  # those of bindings are not installed
    alone = [f'#include "{header}"\n' for header in headers]
    for number, text in enumerate(alone):
        check_syntax(include, text, tmp_path / f"{number}.cpp")
    check_syntax(include, "".join(alone), tmp_path / "together.cpp")


@pytest.mark.parametrize("header", ["core/simd.h", "raster/raster_simd.h", "raster/raster_tiles.h"])
def test_other_headers_compile_alone(header, tmp_path):
    baseline = ["-march=x86-64-v3"] if platform.machine() in ("x86_64", "AMD64") else []
    check_syntax(ROOT / "csrc", f'#include "gsim3d/{header}"\n', tmp_path / "alone.cpp", *baseline)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="nvcc is not installed")
def test_every_cuda_source_compiles(tmp_path):
    """And a stranger's CUDA program builds against the install tree, and runs where a GPU is."""
    run(
        "cmake",
        "-G",
        "Ninja",
        "-S",
        ROOT,
        "-B",
        tmp_path / "build",
        "-DGSIM3D_CUDA=ON",
        "-DGSIM3D_BUILD_TESTS=OFF",
        "-DCMAKE_CUDA_ARCHITECTURES=90a-real",
    )
    run("cmake", "--build", tmp_path / "build", "--parallel", str(len(os.sched_getaffinity(0))))
    objects = {path.name.removesuffix(".o") for path in tmp_path.rglob("*.cu.o")}
    assert objects == {path.name for path in (ROOT / "csrc").rglob("*.cu")} and objects
    run("cmake", "--install", tmp_path / "build", "--prefix", tmp_path / "prefix")
    consumer, prefix = ROOT / "tests" / "cpp" / "consumer", tmp_path / "prefix"
    options = [f"-DCMAKE_PREFIX_PATH={prefix}", "-DCMAKE_CUDA_ARCHITECTURES=90a-real"]
    run("cmake", "-G", "Ninja", "-S", consumer, "-B", tmp_path / "app", *options)
    run("cmake", "--build", tmp_path / "app")
    if torch.cuda.is_available():
        assert run(tmp_path / "app" / "app_cuda").split() == ["3", "3"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="nvcc is not installed")
@pytest.mark.parametrize("architecture", [80, 100])
def test_every_cuda_source_is_valid_for_other_gpus(architecture, tmp_path):
    """Only translated, for nvcc takes a third of the time where it does not optimise."""
    quick = ["--Ofast-compile=max"] if "--Ofast-compile" in run("nvcc", "--help") else []
    language = ["-std=c++20", "--extended-lambda", "--expt-relaxed-constexpr", f"-arch=sm_{architecture}", *quick]
    sources = sorted((ROOT / "csrc").rglob("*.cu"))

    def translate(source):
        run("nvcc", *language, "-I", ROOT / "csrc", "-c", source, "-o", tmp_path / f"{source.stem}.o")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(translate, sources))
    assert len(list(tmp_path.glob("*.o"))) == len(sources) > 0
