"""``gsim3d import``: a checkpoint of the authors' release becomes one of this package."""

from __future__ import annotations

import argparse

EPILOG = """\
CHECKPOINT is a .ckpt file of the release, CONFIG the resolved .yaml that lies beside it (configs/NAME.yaml for
models/NAME.ckpt): sizes come from the weights, what no weight shows (cell size, strides, limits, history) from it.
DIR becomes a checkpoint folder that simulate and evaluate take; its model reproduces the published one, oddities
included (DIR/config.yaml has "release: true"). Tensors that are missing or of another shape are named, and nothing is
written. The file is read without running anything in it: one that asks for other code is refused.

examples:
  gsim3d import models/elastic.ckpt --config configs/elastic.yaml -o runs/elastic
  gsim3d evaluate runs/elastic DATA
  gsim3d simulate runs/elastic DATA/bunny/0 --out runs/bunny
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Imports a checkpoint of the authors' release and tells what it found in it."
    parser.epilog = EPILOG
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="published checkpoint (.ckpt)")
    parser.add_argument("--config", metavar="CONFIG", required=True, help="its resolved configuration (.yaml)")
    parser.add_argument("-o", "--out", metavar="DIR", required=True, help="folder to write; must not exist yet")


def run(args: argparse.Namespace) -> int:
    from gsim3d.compat.released_import import write_imported

    print(write_imported(args.checkpoint, args.config, args.out))
    return 0
