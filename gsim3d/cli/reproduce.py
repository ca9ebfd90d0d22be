"""Measures every table and figure of the paper that the data at hand allow; one page.

Tables, each with cost, seed, device, paired standard errors against the first row, the change since the last run in
DIR, and the paper's value, which is of other data:

  Main table                    every model, constant, copy, constant velocity, Spring-Gaus; physical measures
  Speed                         encoding, and a simulated step with its images
  History length at inference   2 and 1 input steps, beside the model as trained
  Input cameras at inference    3, 2 and 1 cameras, beside the model as trained
  Edits                         thrown, duplicated, without ground, ground raised: a figure, shapes, fall, landing
  Ablations                     rows of gsim3d/evaluate/ablations.yaml, trained here (--train)

All methods predict the same steps after 4 given ones and are scored from the same cameras. Without --data, scenes of
`gsim3d generate WORLD --preset published --seed 77` are made in DIR/data. LPIPS and FVD need weights
(`gsim3d weights`), and Spring-Gaus a GPU.

Scenes are measured in turn: a short --budget gives all rows of few scenes. Every measurement is a file in DIR/cells;
the next call with the same options continues. Other weights or code (of times: machines) are measured again, and the
values before move to DIR/last. --train needs scenes of another seed: DIR/data/WORLD-train is generated (--preset
mini), or read from DATA/WORLD-train.

Output in DIR: reproduce.md, reproduce.json, figures/.

examples:
  gsim3d reproduce --out runs/paper --device cuda
  gsim3d reproduce --out runs/quick --worlds elastic --trajectories 2 --steps 4 --budget 3
  gsim3d reproduce elastic-small runs/gns/model.safetensors --worlds elastic --out runs/compared --device cuda
  gsim3d reproduce elastic=runs/elastic rigid=runs/rigid --worlds elastic rigid --data data --out runs/own
  gsim3d reproduce --out runs/paper --train 2000 --preset small --budget 120 --device cuda
"""

import argparse

from gsim3d.cli.arguments import number, whole
from gsim3d.pretrained import CHECKPOINT_HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    model = f"{CHECKPOINT_HELP}; without WORLD it is scored in all worlds (default: the shipped simulators)"
    add("models", metavar="[WORLD=]CHECKPOINT", nargs="*", help=model)
    add("--out", metavar="DIR", required=True, help="folder of results, created or continued")
    add("--worlds", nargs="+", metavar="WORLD", help="worlds (default: elastic cloth rigid, or the folders of DATA)")
    add("--data", metavar="DATA", help="folder with a folder of scenes for each world (default: generated)")
    add("--trajectories", type=whole(1), default=6, metavar="N", help="scenes of each world (default: 6)")
    add("--steps", type=whole(1), metavar="N", help="number of steps to predict (default: to the end)")
    help = "time limit; what is being measured when it ends is completed, the rest listed as missing"
    add("--budget", type=number(0, above=True), metavar="MINUTES", help=help)
    help = "train the ablations, too, in STEPS optimizer steps each (default: those of the base run)"
    add("--train", type=whole(0), nargs="?", const=0, metavar="STEPS", help=help)
    add("--preset", metavar="PRESET", help="base run of --train: tiny (default), small, paper_latent")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="device (default: cpu)")


def run(args: argparse.Namespace) -> int:
    import shlex
    import sys
    from functools import partial

    from gsim3d.reproduce.run import Job, reproduce

    command = shlex.join(["gsim3d", "reproduce", *sys.argv[2:]])
    content, files = reproduce(Job(**vars(args)), command, partial(print, flush=True))
    print(*(f"missing: {line}" for line in content["missing"]), f"written: {files[0]}, {files[1]}", sep="\n")
    return 0
