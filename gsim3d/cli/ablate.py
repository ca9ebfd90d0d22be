"""``gsim3d ablate``: the paper's ablations."""

from __future__ import annotations

import argparse
import math

from gsim3d.cli.arguments import number, whole

EPILOG = """\
Every row is the base run with one thing changed, trained on the same scenes for as many steps and scored on the scenes
that `gsim3d train` holds out, all rows over the same steps. The base run is CONFIG (as of gsim3d train) or, without it,
the paper's history, views and horizon at the size of --preset. --list names the rows.

Written to DIR: ablation.md and ablation.json (one table: PSNR beside baselines, seconds a step, the paper's number) and
a run folder ROW/seed_N for each training. Stopped and started again, it goes on where it was; rows that are done stay.
--steps is what every run gets; --minutes stops this call, and the next one goes on.
More rows or seeds may be asked for later; the table has those of the last call. Differences are against its first row;
with --seeds, those that are not larger than what the seed alone does are a tie. How to read it:
docs/results/accuracy_vs_time.md.

examples:
  gsim3d ablate --list
  gsim3d ablate runs/data --out runs/ablation --steps 600
  gsim3d ablate runs/data --rows latent,no-tem,rollout-2 --seeds 3 --together 9 --out runs/ablation --device cuda
  gsim3d ablate runs/data --config train.yaml --rows latent,grid-half,grid-double --out runs/grids
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Trains and scores the paper's ablations at a budget of your choice; one table out."
    parser.epilog = EPILOG
    parser.add_argument(
        "data", metavar="DATA", nargs="?", help="folder with scenes of any layout (docs/reference/data.md)"
    )
    parser.add_argument("--rows", metavar="ROW,...", help="rows to train (default: latent,explicit,no-tem)")
    parser.add_argument("--out", metavar="DIR", help="folder for the runs and the table; made if absent")
    parser.add_argument("--config", metavar="CONFIG", help="YAML file of the base run (default: one of --preset)")
    parser.add_argument(
        "--preset",
        choices=("tiny", "small", "paper_latent"),
        help="size of the base model (default: CONFIG's, or tiny)",
    )
    parser.add_argument(
        "--steps", type=whole(1), metavar="N", help="optimizer steps of each run (default: the base run's)"
    )
    parser.add_argument("--seeds", type=whole(1), default=1, metavar="N", help="runs of each row (default: 1)")
    parser.add_argument(
        "--together",
        type=whole(1),
        default=1,
        metavar="N",
        help="runs at a time, a process each: a small model leaves most of a GPU idle (default: 1)",
    )
    parser.add_argument(
        "--minutes", type=number(0, above=True), metavar="M", help="train no longer; the next call goes on"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to train (default: cpu)")
    parser.add_argument("--list", action="store_true", help="print the rows and exit")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")


def run(args: argparse.Namespace) -> int:
    import dataclasses
    import shlex
    import sys
    from functools import partial
    from pathlib import Path

    from gsim3d.ablate.rows import DEFAULT_ROWS, ROWS, base_run, rows_named, with_steps
    from gsim3d.errors import InputError

    if args.list:
        width = max(map(len, ROWS)) + 2
        print(*(f"{row.name:{width}}{row.differs}" for row in ROWS.values()), sep="\n")
        return 0
    for name in ("data", "out"):
        if getattr(args, name) is None:
            raise InputError(f"{'DATA' if name == 'data' else '--out'} is needed (see gsim3d ablate --help)")
    rows = rows_named(",".join(DEFAULT_ROWS) if args.rows is None else args.rows)

    from gsim3d.ablate.study import Study
    from gsim3d.ablate.table import markdown
    from gsim3d.data import find_scenes
    from gsim3d.io.locks import only_one_writer
    from gsim3d.io.settings import from_dict, load_yaml
    from gsim3d.train.config import TrainConfig

    if args.config is None:
        base = base_run(args.preset or "tiny")
    else:
        base = from_dict(TrainConfig, load_yaml(args.config))
        base = base if args.preset is None else dataclasses.replace(base, preset=args.preset)
    base = base if args.steps is None else with_steps(base, args.steps)
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    study = Study(base, rows, find_scenes(args.data), n_seeds=args.seeds, device=args.device)
    command = shlex.join(["gsim3d", "ablate", *sys.argv[2:]])
    limits = {"together": args.together, "minutes": math.inf if args.minutes is None else args.minutes}
    out.mkdir(parents=True, exist_ok=True)
    with only_one_writer(out):
        content = study.run(out, command, **limits, progress=not args.quiet, say=partial(print, flush=True))
    print(markdown(content), f"written: {out / 'ablation.md'}, {out / 'ablation.json'}", sep="\n")
    return 1 if any("failure" in run for row in content["rows"] for run in row["runs"]) else 0
