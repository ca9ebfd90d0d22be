"""Builds gsim3d._ops (torch ops, stable ABI) and gsim3d._core (the torch-free core for numpy, pybind11).

GSIM3D_CUDA=0 leaves CUDA out, GSIM3D_CUDA=1 insists on it; default: CUDA when a GPU is visible, torch has CUDA and nvcc
is found. TORCH_CUDA_ARCH_LIST chooses the GPUs to build for; default: the visible ones, or sm_80, sm_90a and sm_100.
"""

import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

from pybind11.setup_helpers import Pybind11Extension
from setuptools import setup
from torch.utils import cpp_extension

ROOT = Path(__file__).parent
CPU_FLAGS = ["-O3", "-std=c++20", "-fopenmp-simd", "-ffp-contract=off", "-fvisibility=hidden", "-Wall"]
if platform.machine() in ("x86_64", "AMD64"):
    CPU_FLAGS.append("-march=x86-64-v3")  # a fixed baseline: the same bits on every machine, no -march=native


def sources(*suffixes: str) -> list[str]:
    """The files of all ops, one folder each, that end with one of ``suffixes``."""
    folder = ROOT / "csrc" / "gsim3d"
    found = [path for suffix in suffixes for path in sorted(folder.glob(f"*/*{suffix}"))]
    return [str(path.relative_to(ROOT)) for path in found]


def wants_cuda() -> bool:
    choice = os.environ.get("GSIM3D_CUDA", "")
    if choice not in ("", "0", "1"):
        raise SystemExit(f"GSIM3D_CUDA must be 0 or 1; got {choice!r}")
    import torch

    possible = torch.version.cuda is not None and cpp_extension.CUDA_HOME is not None
    if choice == "1" and not possible:
        raise SystemExit("GSIM3D_CUDA=1, but this torch has no CUDA or nvcc was not found (set CUDA_HOME)")
    return possible and (choice == "1" or (choice == "" and torch.cuda.device_count() > 0))


def check_compiler() -> None:
    """A GCC without a shared libstdc++ puts its own copy into the extension; exceptions then cannot leave it, and an
    error message would end the process."""
    command = shlex.split(os.environ.get("CXX", "c++"))
    try:
        answer = [
            subprocess.run([*command, option], capture_output=True, text=True).stdout.strip()
            for option in ("--version", "-print-file-name=libstdc++.so")
        ]
    except FileNotFoundError:
        raise SystemExit(f"the C++ compiler {command[0]} was not found: install one, or set CXX") from None
    if "Free Software Foundation" in answer[0] and not os.path.isabs(answer[1]):
        raise SystemExit(f"{command[0]} has no shared libstdc++: set CXX to one that has, such as CXX=/usr/bin/g++")


def cuda_architectures() -> str:
    import torch

    found = sorted({torch.cuda.get_device_capability(i) for i in range(torch.cuda.device_count())})
    # 9.0a: the instructions of Hopper alone (wgmma, setmaxnreg)
    return ";".join("9.0a" if c == (9, 0) else f"{c[0]}.{c[1]}" for c in found) or "8.0;9.0a;10.0"


def ops_extension():
    cuda = wants_cuda()
    define = ["-DTORCH_TARGET_VERSION=0x020b000000000000"]
    make = cpp_extension.CUDAExtension if cuda else cpp_extension.CppExtension
    flags = {"cxx": CPU_FLAGS + define + (["-DUSE_CUDA"] if cuda else [])}
    if cuda:
        os.environ.setdefault("TORCH_CUDA_ARCH_LIST", cuda_architectures())
        # torch's builder takes the operators of half types away; the core is compiled the same with and without torch
        undo = [
            f"-U__CUDA_NO_{name}__"
            for name in ("HALF_OPERATORS", "HALF_CONVERSIONS", "HALF2_OPERATORS", "BFLOAT16_CONVERSIONS")
        ]
        flags["nvcc"] = ["-O3", "-std=c++20", "--extended-lambda", "-lineinfo", *undo, *define]
    return make(
        "gsim3d._ops",
        ["csrc/gsim3d/torch/schemas.cpp", "csrc/gsim3d/core/parallel.cpp"]
        + sources("_cpu.cpp", "_torch.cpp")
        + (sources("_cuda.cu") if cuda else []),
        include_dirs=[str(ROOT / "csrc")],
        extra_compile_args=flags,
        py_limited_api=True,
    )


def core_extension():
    return Pybind11Extension(
        "gsim3d._core",
        ["csrc/gsim3d/numpy/core.cpp", "csrc/gsim3d/core/parallel.cpp", *sources("_cpu.cpp")],
        include_dirs=[str(ROOT / "csrc")],
        extra_compile_args=CPU_FLAGS,
        cxx_std=20,
    )


class BuildExtension(cpp_extension.BuildExtension):
    def run(self):
        if sys.platform == "linux":
            check_compiler()
        super().run()


setup(
    ext_modules=[ops_extension(), core_extension()],
    cmdclass={"build_ext": BuildExtension},
    options={"bdist_wheel": {"py_limited_api": False}},
)
