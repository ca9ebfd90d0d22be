"""``gsim3d doctor``: what is installed, compiled and missing, how to get it, and a self-test of every op."""

import argparse
import importlib
import importlib.metadata
import platform
import sys
import time

from gsim3d.cli.arguments import whole

EPILOG = """\
Without options: what is installed and compiled, and every op against plain torch.

With --stability: does the model keep its laws (the same scene moved, turned, reordered, repeated, split, or with a far
particle more has the same future), and does it stay finite on hard input made of your scenes (black images, one view,
numbers that are none, crowds, strange cameras, a long rollout, gradients)? Each failure names camera, particle and
step, and leaves a file in DIR/failures that makes it happen again. The report is DIR/report.md and DIR/report.json.
What a simulator that comes with gsim3d is known to break, by its model card, is called a known failure.

examples:
  gsim3d doctor
  gsim3d doctor --stability runs/model runs/data
  gsim3d doctor --stability elastic-small runs/data --full
  gsim3d doctor --stability small my_scene --steps 1000
  gsim3d doctor --stability --replay runs/stability/failures/translate.safetensors

Exit code 0: everything required works, every law and case holds. 1: something is broken, known or not; the lines say
what. 2: the check could not run.
"""

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
    parser.epilog = EPILOG
    group = parser.add_argument_group("stability of a model or of scenes")
    group.add_argument(
        "--stability",
        nargs="*",
        metavar="PATH",
        help="check laws and hard cases instead: of a checkpoint, or of a preset with random weights (default: tiny), "
        "on a scene or folder of scenes (default: random images)",
    )
    group.add_argument(
        "--out", metavar="DIR", default="runs/stability", help="folder of the report (default: %(default)s)"
    )
    group.add_argument("--steps", type=whole(1), default=100, help="length of the long rollout (default: %(default)s)")
    group.add_argument("--only", nargs="+", metavar="CHECK", default=(), help="checks to make (default: all)")
    group.add_argument(
        "--full", action="store_true", help="all particles, four views and the whole history (default: a sample)"
    )
    group.add_argument("--replay", metavar="FILE", help="make the check again that FILE, from a report, reproduces")
    group.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute (default: cpu)")


def run(args: argparse.Namespace) -> int:
    if args.stability is not None or args.replay:
        return _stability(args)
    healthy = _versions()
    healthy &= _compiled()
    return 0 if healthy else 1


def _stability(args: argparse.Namespace) -> int:
    from pathlib import Path

    from gsim3d.testing.check_stability import Job, describe, replay
    from gsim3d.testing.check_stability import run as check
    from gsim3d.train.restore import check_device

    check_device(args.device)
    if args.replay:
        report = replay(args.replay, args.device)
        print(describe(report))
        return 0 if report.healthy else 1
    job = Job(args.stability, Path(args.out), args.steps, args.only, args.device, full=args.full)
    report = check(job)
    print(describe(report))
    print(f"written: {job.out / 'report.md'}, {job.out / 'report.json'}")
    return 0 if report.healthy else 1


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
    _row(
        "ok", "gsim3d._ops", f"CPU kernels ({torch.get_num_threads()} threads)" + (" and CUDA kernels" if cuda else "")
    )
    if torch.cuda.is_available():
        _row("ok" if cuda else "-", "GPU", torch.cuda.get_device_name())
    if not cuda:
        _row("-", "CUDA kernels", "not compiled (needs torch with CUDA, nvcc, and a visible GPU or GSIM3D_CUDA=1)")
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
