"""``gsim3d profile``: what accuracy costs in time."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import number
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP

EPILOG = """\
Runs the simulator under every setting that it has here, one changed at a time: precision, graph capture, input views
and steps, particles kept, sleep, patch and grid size, ... For each: how far it is from the reference run of the same
checkpoint (float32, nothing left out) and from the video, and what a step takes, by section. Written to DIR:
report.html (one page, needs no network), report.json, report.csv, a PNG of each figure. Beside the checkpoint:
speeds.json, the fastest settings that keep 99.9 % ("balanced") and 99 % ("fast") of the reference's gain over particles
that hold still, for --speed, and the times of the reference, by which `gsim3d plan` predicts milliseconds.
Stopped and started again with the same DIR, it goes on where it was.

examples:
  gsim3d profile runs/model runs/data --out runs/profile
  gsim3d profile runs/model runs/data --preset full --device cuda --out runs/profile
  gsim3d profile elastic-small data/elastic-unseen --scenes all --settings history "grid size" --out runs/profile
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Measures what accuracy costs in time, for one trained simulator on this machine."
    parser.epilog = EPILOG
    add = parser.add_argument
    add("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    add("data", metavar="DATA", help="folder with scenes, or one scene folder")
    scenes = "which of DATA: test, the scenes that `gsim3d train` holds out (default), or all: it is a held-out set"
    add("--scenes", choices=("test", "all"), default="test", help=scenes)
    add("--out", metavar="DIR", required=True, help="folder of the report; made if absent")
    add("--preset", choices=("quick", "full"), default="quick", help="how long to measure (default: quick)")
    add("--settings", nargs="+", metavar="NAME", help="change only these (default: all)")
    add("--metrics", nargs="+", metavar="METRIC", help="of the error against the video, as of gsim3d evaluate")
    limit = "end in about so many; the report says what there was no time for (default: no limit)"
    add("--minutes", type=number(0, 1e6, above=True), metavar="M", help=limit)
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
