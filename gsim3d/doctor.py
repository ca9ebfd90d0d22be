"""``gsim3d doctor``: what is installed, what was compiled, what is missing and how to get it, and a self-test of every op."""

import argparse
import importlib
import importlib.metadata
import platform
import sys
import time

# distribution -> (import name, what it is for, how to get it)
OPTIONAL = {
    "mujoco-core": ("mujoco", "generate: physics", "pip install 'gsim3d[generate]'"),
    "embreex": ("embreex", "generate: ray tracing", "pip install 'gsim3d[generate]'"),
    "matplotlib": ("matplotlib", "plots of demo and evaluate", "pip install 'gsim3d[plot]'"),
    "pytest": ("pytest", "the tests", "pip install 'gsim3d[dev]'"),
}
REQUIRED = ["torch", "numpy", "opencv-contrib-python-headless", "pyyaml", "safetensors", "tqdm", "trimesh"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = __doc__
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "Exit code 0: everything required works. 1: something required is broken; the line says what to do."


def run(args: argparse.Namespace) -> int:
    healthy = _versions()
    healthy &= _compiled()
    return 0 if healthy else 1


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


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
        version = _version(name)
        # Any build of OpenCV's Python wheel serves.
        if version is None and name.startswith("opencv"):
            version = next(filter(None, map(_version, ("opencv-python", "opencv-python-headless"))), None)
        healthy &= version is not None
        _row("ok" if version else "FAIL", name, version or f"missing: pip install {name}")
    print("Optional parts")
    for name, (module, purpose, command) in OPTIONAL.items():
        version = _version(name)
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
        from gsim3d.ops import selftest
    except ImportError as error:
        _row("FAIL", "gsim3d._ops", str(error).splitlines()[0])
        return False
    cuda = ops.cuda_compiled()
    _row("ok", "gsim3d._ops", f"CPU kernels ({torch.get_num_threads()} threads)" + (" and CUDA kernels" if cuda else ""))
    if torch.cuda.is_available():
        _row("ok" if cuda else "-", "GPU", torch.cuda.get_device_name())
    if not cuda:
        _row("-", "CUDA kernels", "not compiled (needs a CUDA build of torch and nvcc; GSIM3D_CUDA=1 insists)")
    devices = ["cpu"] + (["cuda"] if cuda and torch.cuda.is_available() else [])
    for device in devices:
        print(f"Self-test on {device} (forward and backward against plain torch)")
        for name, check in selftest.CHECKS.items():
            start = time.perf_counter()
            try:
                error = check(device)
                _row("ok", name, f"worst relative error {error:.1e}, {1e3 * (time.perf_counter() - start):.0f} ms")
            except Exception as problem:  # the doctor reports whatever is wrong and goes on
                _row("FAIL", name, f"{type(problem).__name__}: {problem}")
                healthy = False
    return healthy
