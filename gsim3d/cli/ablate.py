"""Trains and scores the paper's ablations at a given budget; writes a table.

Every row is the base run with one change, trained on the same scenes for the same number of steps, and scored on the
scenes that `gsim3d train` holds out over the same steps. Rows and base runs are declared in
gsim3d/evaluate/ablations.yaml, or in the file of --table; --list prints the rows.

Output in DIR: ablation.md and ablation.json (a table of PSNR with baselines, paired differences, seconds per step, and
the paper's numbers), and a run folder ROW/seed_N for each training. Run again, the command resumes. Rows and seeds can
be added later; the table contains those of the last call, compared with the first row.

examples:
  gsim3d ablate --list
  gsim3d ablate runs/data --out runs/ablation --steps 600
  gsim3d ablate runs/data --rows latent,no-tem,rollout-2 --seeds 3 --together 9 --out runs/ablation --device cuda
  gsim3d ablate runs/data --config train.yaml --rows latent,grid-half,grid-double --out runs/grids
"""

import argparse
import math

from gsim3d.cli.arguments import number, whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("data", metavar="DATA", nargs="?", help="folder with scenes of any layout (docs/reference/data.md)")
    add("--rows", default="latent,explicit,no-tem", metavar="ROW,...", help="rows to train (default: %(default)s)")
    add("--table", metavar="FILE", help="YAML file of rows and base runs (default: the paper's)")
    add("--out", metavar="DIR", help="folder for the runs and the table, created if absent")
    add("--config", metavar="CONFIG", help="YAML file of the base run, as for gsim3d train (default: see --preset)")
    add("--preset", metavar="PRESET", help="base run without --config (default: tiny)")
    add("--steps", type=whole(1), metavar="N", help="optimizer steps of each run (default: the base run's)")
    add("--seeds", type=whole(1), default=1, metavar="N", help="runs per row (default: 1)")
    help = "number of parallel runs, one process each; useful for small models on a GPU (default: 1)"
    add("--together", type=whole(1), default=1, metavar="N", help=help)
    add("--minutes", type=number(0, above=True), metavar="M", help="time limit; the next call resumes")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="device (default: cpu)")
    add("--list", action="store_true", help="print the rows and exit")
    add("--quiet", action="store_true", help="no progress bars")


def run(args: argparse.Namespace) -> int:
    import shlex
    import sys
    from functools import partial
    from pathlib import Path

    from gsim3d.data import find_scenes
    from gsim3d.errors import InputError
    from gsim3d.evaluate.ablations import PAPER, Study, base_run, load_ablations, markdown, rows_named
    from gsim3d.train.run import run_folder

    bases, rows = load_ablations(PAPER if args.table is None else Path(args.table))
    if args.list:
        width = max(map(len, rows)) + 2
        print(*(f"{row.name:{width}}{row.differs}" for row in rows.values()), sep="\n")
        return 0
    if args.data is None or args.out is None:
        raise InputError(f"{'DATA' if args.data is None else '--out'} is required (see gsim3d ablate --help)")
    chosen = rows_named(args.rows, rows)
    base, out = base_run(bases, args.preset, args.config, args.steps), Path(args.out)
    study = Study(base, chosen, find_scenes(args.data), n_seeds=args.seeds, device=args.device)
    command = shlex.join(["gsim3d", "ablate", *sys.argv[2:]])
    limits = {"together": args.together, "minutes": math.inf if args.minutes is None else args.minutes}
    with run_folder(out):
        content = study.run(out, command, **limits, progress=not args.quiet, say=partial(print, flush=True))
    print(markdown(content), f"written: {out / 'ablation.md'}, {out / 'ablation.json'}", sep="\n")
    return 1 if any("failure" in run for row in content["rows"] for run in row["runs"]) else 0
