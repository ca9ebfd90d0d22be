"""Checks of the installation and self-tests of all ops (``gsim3d doctor``). Works without torch."""

import importlib
import platform
import sys
import time

from gsim3d.io.machine import version_of

# distribution -> (import name, purpose, install command)
OPTIONAL = {
    "mujoco-core": ("mujoco", "generate: physics", "pip install 'gsim3d[generate]'"),
    "embreex": ("embreex", "generate: ray tracing", "pip install 'gsim3d[generate]'"),
    "matplotlib": ("matplotlib", "plots of demo and evaluate", "pip install 'gsim3d[plot]'"),
    "viser": ("viser", "gsim3d view", "pip install 'gsim3d[viewer]'"),
    "pytest": ("pytest", "the tests", "pip install 'gsim3d[dev]'"),
}
REQUIRED = ["torch", "numpy", "opencv-contrib-python-headless", "pyyaml", "safetensors", "tqdm", "trimesh"]


def check_installation() -> bool:
    """Prints a line for every package, compiled module and op. Returns whether all required ones work."""
    return all([_versions(), _compiled()])


def _row(mark: str, name: str, text: str) -> None:
    print(f"  {mark:<4} {name:<32} {text}")


def _versions() -> bool:
    from gsim3d import __version__

    print("Versions")
    _row("ok", "gsim3d", __version__)
    in_range = (3, 11) <= sys.version_info[:2] <= (3, 13)
    _row("ok" if in_range else "warn", "python", f"{platform.python_version()} ({platform.platform()})")
    healthy = True
    for name in REQUIRED:
        version = version_of(name)
        if version is None and name.startswith("opencv"):  # any OpenCV wheel will do
            version = next(filter(None, map(version_of, ("opencv-python", "opencv-python-headless"))), None)
        healthy &= version is not None
        _row("ok" if version else "FAIL", name, version or f"missing: pip install {name}")
    print("Optional parts")
    for name, (module, purpose, command) in OPTIONAL.items():
        version = version_of(name)
        if version is None:
            _row("-", name, f"not installed ({purpose}): {command}")
            continue
        try:
            importlib.import_module(module)
            _row("ok", name, f"{version} ({purpose})")
        except Exception as error:  # a broken wheel can raise anything
            _row("FAIL", name, f"{version} does not import: {error}")
            healthy = False
    return healthy


def _compiled() -> bool:
    print("Compiled")
    healthy = True
    try:
        from gsim3d import _core

        info = _core.build_info()
        _row("ok", "gsim3d._core", f"numpy kernels, compiler {info['compiler']}, {info['baseline']}")
    except ImportError as error:
        _row("FAIL", "gsim3d._core", f"{error}; rebuild: pip install --no-build-isolation -e .")
        healthy = False
    try:
        import torch

        from gsim3d import ops
    except ImportError as error:
        _row("FAIL", "gsim3d._ops", str(error).splitlines()[0])
        return False
    cuda, has_gpu = ops.cuda_compiled(), torch.cuda.is_available()
    kernels = " and CUDA kernels" if cuda else ""
    _row("ok", "gsim3d._ops", f"CPU kernels (threads: {torch.get_num_threads()}){kernels}")
    if has_gpu:
        _row("ok" if cuda else "-", "GPU", torch.cuda.get_device_name())
    if not cuda:
        _row("-", "CUDA kernels", "not compiled (needs torch with CUDA, nvcc, and a visible GPU or GSIM3D_CUDA=1)")
    return all([_ops_work(device) for device in (["cpu", "cuda"] if cuda and has_gpu else ["cpu"])]) and healthy


def _ops_work(device: str) -> bool:
    from gsim3d.testing import selftest

    healthy = True
    print(f"Self-test on {device} (forward and backward against known answers)")
    for name in selftest.CHECKS:
        start = time.perf_counter()
        try:
            error = selftest.check(name, device)
            _row("ok", name, f"worst relative error {error:.1e}, {1e3 * (time.perf_counter() - start):.0f} ms")
        except Exception as problem:  # reports whatever is wrong and continues
            _row("FAIL", name, f"{type(problem).__name__}: {problem}")
            healthy = False
    return healthy
