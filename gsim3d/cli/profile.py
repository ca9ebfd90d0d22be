"""Measures accuracy against time of a trained simulator on this machine.

Changes one setting of the simulator at a time: precision, graph capture, input views and steps, retained particles,
sleep, patch and grid size, ... For each setting, it measures the error against the reference run (same checkpoint in
float32) and against the video, and the time of a step by section. Written to DIR: report.html (one page, needs no
network), report.json, report.csv and the figures as PNG. Written to the checkpoint: speeds.json, with the fastest
settings that retain 99.9 % ("balanced") and 99 % ("fast") of the reference's gain over the constant baseline, for
--speed, and the times of the reference, from which `gsim3d plan` predicts milliseconds. Where --settings or --minutes
leave settings out, speeds that the checkpoint has already are kept: those measured are written to DIR/speeds.json.
An interrupted command continues when it is run again with the same DIR.

examples:
  gsim3d profile elastic-small --out runs/profile
  gsim3d profile runs/model runs/data --out runs/profile
  gsim3d profile runs/model runs/data --preset full --device cuda --out runs/profile
  gsim3d profile elastic-small data/elastic-unseen --scenes all --settings history "grid size" --out runs/profile
"""

import argparse

from gsim3d.cli.arguments import number
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    data = "folder with scenes, or one scene folder (default: two scenes, generated in DIR/scenes)"
    add("data", metavar="DATA", nargs="?", help=data)
    scenes = "test: the scenes that `gsim3d train` holds out (default); all: every scene, for a held-out set"
    add("--scenes", choices=("test", "all"), default="test", help=scenes)
    add("--out", metavar="DIR", required=True, help="folder of the report; created if absent")
    add("--preset", choices=("quick", "full"), default="quick", help="number of measurements (default: quick)")
    add("--settings", nargs="+", metavar="NAME", help="groups of settings to measure (default: all)")
    add("--metrics", nargs="+", metavar="METRIC", help="scores against the video, as in gsim3d evaluate")
    add("--minutes", type=number(0, 1e6, above=True), metavar="M", help="approximate time limit (default: none)")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to simulate (default: cpu)")
    add("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    from pathlib import Path

    from gsim3d.profile.report import profile, table

    options = {name: value for name, value in vars(args).items() if name not in ("out", "quiet")}
    with progress(unit="run", quiet=args.quiet) as bar:

        def advance(doing: str) -> None:
            bar.set_description(doing[:60], refresh=False)
            bar.update()

        content, files = profile(out=Path(args.out), progress=advance, **options)
    print(table(content))
    for name, index in content["presets"].items():
        row = content["settings"][index]
        print(f"--speed {name}: {row['name']}, {row['step_ms']['median']:.2f} ms a step")
    print("written: " + ", ".join(map(str, files)))
    return 0
