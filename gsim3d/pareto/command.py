"""``gsim3d pareto``: what accuracy costs in time."""

from __future__ import annotations

import argparse

from gsim3d.pretrained import CHECKPOINT_HELP

EPILOG = """\
Turns every knob that the model has, one at a time: precision, graph capture, input views and steps, particles kept,
patch and grid size, image size, ... For each setting: how far it is from the reference run of the same checkpoint
(float32, nothing left out) and from the truth, and what a step takes, by stage. Written to DIR: report.html (one page,
needs no network), report.json, report.csv, a PNG of each figure. Beside the checkpoint: speeds.json, the fastest settings
that keep 99.9 % ("balanced") and 99 % ("fast") of the reference's gain over particles that hold still, for
`gsim3d simulate --speed`.

Without DATA, held-out scenes of the mini preset are generated in DIR/data (needs pip install 'gsim3d[generate]').

examples:
  gsim3d pareto runs/model runs/data --out runs/pareto
  gsim3d pareto runs/model runs/data --preset full --device cuda --self-check --out runs/pareto
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Measures what accuracy costs in time, for one trained simulator on this machine."
    parser.epilog = EPILOG
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    parser.add_argument("data", metavar="DATA", nargs="?", help="folder with scenes, or one scene folder")
    parser.add_argument("--out", metavar="DIR", required=True, help="folder of the report; made if absent")
    parser.add_argument(
        "--preset", choices=("quick", "full"), default="quick", help="how long to measure (default: quick)"
    )
    parser.add_argument("--knobs", nargs="+", metavar="KNOB", help="turn only these (default: all)")
    parser.add_argument(
        "--self-check", action="store_true", help="check the timing itself first; the report says how it went"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to simulate (default: cpu)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    import shlex
    import sys
    from pathlib import Path

    from tqdm import tqdm

    from gsim3d.errors import InputError
    from gsim3d.evaluate.pictures import pyplot
    from gsim3d.pareto import autotune, report
    from gsim3d.pareto.measure import FULL, QUICK, Comparison, Subject, compare, points_of, time_points
    from gsim3d.pareto.regimes import throughput, training_step
    from gsim3d.pareto.self_check import self_check
    from gsim3d.pareto.settings import KNOBS
    from gsim3d.pareto.timing import DeviceClock
    from gsim3d.pretrained import located
    from gsim3d.train.restore import restore

    pyplot()
    known = {knob.name: knob for knob in KNOBS}
    if unknown := sorted(set(args.knobs or ()) - set(known)):
        raise InputError(f"--knobs: {unknown[0]!r} does not exist; knobs: {', '.join(map(repr, known))}")
    restored = restore(args.checkpoint, args.device)
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    effort = {"quick": QUICK, "full": FULL}[args.preset]
    scenes = _scenes(args, restored, out, effort.n_scenes)
    subject, clock = Subject(restored, scenes, effort.n_steps), DeviceClock(restored.device)
    points = points_of(restored, [known[name] for name in args.knobs] if args.knobs else KNOBS)
    out.mkdir(parents=True, exist_ok=True)
    checks = []
    if args.self_check:
        blind = DeviceClock(restored.device, waits=False) if args.device == "cuda" else None
        checks = self_check(subject, clock, blind)
        print(*checks, sep="\n")
    comparison = Comparison(subject)
    with tqdm(total=len(points) * (1 + effort.n_rounds), unit="run", disable=args.quiet) as bar:

        def progress(doing: str) -> None:
            bar.set_description(doing[:60], refresh=False)
            bar.update()

        compare(comparison, points, progress)
        if points[0].failure:
            raise InputError(f"{args.checkpoint}: the reference run has no result: {points[0].failure}")
        time_points(subject, points, clock, effort, progress=progress)
    presets = autotune.tune(subject, comparison, points, clock, effort)
    points += [point for point in presets.values() if not any(point is p for p in points)]
    kept = {point.setting: point for point in presets.values()}
    throughputs = [throughput(subject, setting, clock) for setting in kept]
    conditions = {
        "regimes": report.regimes_as_dict(throughputs, training_step(subject, clock)),
        "command": shlex.join(["gsim3d", "pareto", *sys.argv[2:]]),
        "machine": report.machine(restored.device),
        "subject": {
            "checkpoint": restored.checkpoint.digest,
            "scenes": len(scenes),
            "steps": subject.n_steps,
            "image": f"{restored.image_size[0]} x {restored.image_size[1]} pixels",
            "views": len(subject.views[0][1]),
        },
        "self_check": [str(check) for check in checks],
        "presets": {name: point.setting.to_dict() for name, point in presets.items()},
    }
    files = report.write(out, points, comparison, conditions)
    files.append(_keep_speeds(located(args.checkpoint), out, restored, presets))
    print(report.table(report.as_dict(points, comparison, conditions)))
    for name, point in presets.items():
        print(f"--speed {name}: {point.setting.name}, {1e3 * point.step_seconds:.2f} ms a step")
    print("written: " + ", ".join(str(path) for path in files))
    return 0 if all(check.holds for check in checks) else 1


def _keep_speeds(checkpoint, out, restored, presets: dict):
    """Beside the checkpoint, where `gsim3d simulate --speed` looks; in ``out`` where nothing can be written there."""
    from gsim3d.pareto import autotune

    try:
        return autotune.save_speeds(checkpoint if checkpoint.is_dir() else checkpoint.parent, restored, presets)
    except OSError as error:
        print(
            f"{error.filename or checkpoint}: {error.strerror}; copy {autotune.SPEEDS} there for gsim3d simulate --speed"
        )
        return autotune.save_speeds(out, restored, presets)


def _scenes(args: argparse.Namespace, restored, out, count: int | None) -> list:
    """Held-out scenes of DATA, or new ones."""
    from gsim3d.data import find_scenes, split_scenes

    if args.data is None:
        from gsim3d.generate import generate

        folders = generate(
            out / "data",
            preset="mini",
            image_size=restored.image_size[0],
            n_trajectories=count,
            seed=1,
            progress=not args.quiet,
        ).folders
    else:
        folders = find_scenes(args.data)
        folders = split_scenes(folders)[1] or folders
    return [restored.open_scene(folder) for folder in folders[:count]]
