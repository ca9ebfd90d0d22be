"""Imports a checkpoint of the authors' release and reports its content.

CHECKPOINT is a .ckpt file of the release, CONFIG its resolved configuration (configs/NAME.yaml for models/NAME.ckpt).
Sizes are taken from the weights; grid size, strides, limits and history from CONFIG. DIR becomes a checkpoint folder
for simulate and evaluate, whose model reproduces the published one, including its bugs ("release: true" in
DIR/config.yaml). Missing tensors and wrong shapes are an error, and nothing is written. The file is read without
executing code in it; files that reference other code are rejected.

examples:
  gsim3d import models/elastic.ckpt --config configs/elastic.yaml -o runs/elastic
  gsim3d evaluate runs/elastic DATA
  gsim3d simulate runs/elastic DATA/bunny/0 --out runs/bunny
"""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="published checkpoint (.ckpt)")
    parser.add_argument("--config", metavar="CONFIG", required=True, help="its resolved configuration (.yaml)")
    parser.add_argument("-o", "--out", metavar="DIR", required=True, help="folder to write; must not exist")


def run(args: argparse.Namespace) -> int:
    from gsim3d.compat.released_import import write_imported

    print(write_imported(args.checkpoint, args.config, args.out))
    return 0
