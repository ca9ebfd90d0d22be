"""``gsim3d profile``: what accuracy costs in time."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import number
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP

SLOW_METRICS = ("lpips_vgg", "fvd")  # seconds a setting
HURRIED_REPEATS = 5  # of a batch, in a quick report on a CPU
QUICK_FRAMES = 40  # of new scenes: given steps, those simulated without loss, and the horizon of the training
REST = 10  # of the progress bar, behind the settings
SELF_CHECK = 0.1  # of the time is for each part of the self-check, where there is a limit
NO_REGIMES = {"throughput": [], "training": {"problem": "not yet"}, "gpu": []}

EPILOG = """\
Turns every knob that the model has, one at a time: precision, graph capture, input views and steps, particles kept,
sleep, patch and grid size, image size, ... For each setting: how far it is from the reference run of the same
checkpoint (float32, nothing left out) and from the truth, and what a step takes, by stage. Written to DIR: report.html
(one page, needs no network), report.json, report.csv, a PNG of each figure. Beside the checkpoint: speeds.json, the
fastest settings that keep 99.9 % ("balanced") and 99 % ("fast") of the reference's gain over particles that hold still,
for `gsim3d simulate --speed`, and the times of the reference, by which `gsim3d plan` predicts milliseconds.

Without DATA, held-out scenes are generated in DIR/data (needs pip install 'gsim3d[generate]'): of the world and preset
that a simulator that comes with gsim3d was trained on, else soft bodies of the mini preset.

LPIPS and FVD are measured where `gsim3d weights` has installed them; quick leaves out the slow ones, lpips_vgg and fvd.

examples:
  gsim3d profile runs/model runs/data --out runs/profile
  gsim3d profile runs/model runs/data --preset full --device cuda --self-check --out runs/profile
  gsim3d profile elastic-small data/elastic-unseen --scenes all --out runs/profile
  gsim3d profile runs/model runs/data --others runs/two_a_call runs/larger --out runs/profile
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Measures what accuracy costs in time, for one trained simulator on this machine."
    parser.epilog = EPILOG
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    parser.add_argument("data", metavar="DATA", nargs="?", help="folder with scenes, or one scene folder")
    parser.add_argument(
        "--scenes",
        choices=("test", "all"),
        default="test",
        help="which of DATA (default: test, the scenes that `gsim3d train` holds out; all: it is a held-out set)",
    )
    parser.add_argument("--out", metavar="DIR", required=True, help="folder of the report; made if absent")
    parser.add_argument(
        "--preset", choices=("quick", "full"), default="quick", help="how long to measure (default: quick)"
    )
    parser.add_argument("--knobs", nargs="+", metavar="KNOB", help="turn only these (default: all)")
    parser.add_argument(
        "--metrics", nargs="+", metavar="METRIC", help="of the task error, as of gsim3d evaluate (default: see below)"
    )
    parser.add_argument(
        "--others",
        nargs="+",
        default=[],
        metavar="CHECKPOINT",
        help="of knobs that need training: drawn beside this one",
    )
    parser.add_argument(
        "--self-check", action="store_true", help="check the timing itself first; the report says how it went"
    )
    parser.add_argument(
        "--minutes",
        type=number(0, 1e6, above=True),
        metavar="M",
        help="end in about so many; the report says what there was no time for (default: no limit)",
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to simulate (default: cpu)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    import shlex
    import sys
    from dataclasses import replace
    from pathlib import Path

    from tqdm import tqdm

    from gsim3d.errors import InputError, did_you_mean
    from gsim3d.evaluate.pictures import pyplot
    from gsim3d.evaluate.scoring import measurable
    from gsim3d.io.locks import only_one_writer
    from gsim3d.pretrained import located
    from gsim3d.profile import autotune, budget, machine, report
    from gsim3d.profile.limit import REGIMES, TimeLimit
    from gsim3d.profile.measure import FULL, QUICK, QUICK_ON_CPU, Comparison, measure, n_runs, points_of
    from gsim3d.profile.part_times import PartTimes
    from gsim3d.profile.self_check import MOST_SECONDS, self_check
    from gsim3d.profile.settings import KNOBS
    from gsim3d.profile.subject import Subject
    from gsim3d.profile.timing import DeviceClock
    from gsim3d.train.restore import restore

    limit = TimeLimit(None if args.minutes is None else 60 * args.minutes)
    pyplot()
    known = {knob.name: knob for knob in KNOBS}
    if unknown := sorted(set(args.knobs or ()) - set(known)):
        raise InputError(
            f"--knobs: {unknown[0]!r} does not exist; knobs: {', '.join(map(repr, known))}"
            f"{did_you_mean(unknown[0], known)}"
        )
    metrics, not_measured = measurable(args.metrics)
    quick = args.preset == "quick"
    if quick and args.metrics is None:
        metrics = tuple(name for name in metrics if name not in SLOW_METRICS)
        not_measured |= dict.fromkeys(
            set(SLOW_METRICS) - set(not_measured), "slow: named with --metrics, or --preset full"
        )
    restored = restore(args.checkpoint, args.device)
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    effort = replace((QUICK if args.device == "cuda" else QUICK_ON_CPU) if quick else FULL, metrics=metrics)
    if args.knobs:
        effort = replace(effort, fewest_turns=False, slow_turns=True)
    log = budget.log_of(args.checkpoint)
    training = None if log is None else budget.read_log(log)
    scenes = _scenes(args, restored, out, effort.n_scenes)
    subject = Subject(restored, scenes, effort.n_steps, _others(args, budget.earlier_checkpoints(args.checkpoint)))
    clock = DeviceClock(restored.device)
    knobs = [known[name] for name in args.knobs] if args.knobs else KNOBS
    out.mkdir(parents=True, exist_ok=True)
    with only_one_writer(out), progress(total=REST, unit="run", quiet=args.quiet) as bar:

        def advance(doing: str, runs: int = 1) -> None:
            bar.set_description(doing[:60], refresh=False)
            bar.update(runs)
            bar.refresh()

        advance("first input, and which knobs there are", 0)
        points, not_turned = points_of(subject, knobs, effort)
        if training is not None:
            not_turned.pop("training steps", None)  # the figure of the training shows it
        bar.total += n_runs(points, effort)
        checks = []
        if args.self_check:
            blind = DeviceClock(restored.device, waits=False) if args.device == "cuda" else None
            most = limit.part(SELF_CHECK)
            checks = self_check(subject, clock, blind, lambda doing: advance(doing, 0), min(MOST_SECONDS, most), most)
            tqdm.write("\n".join(map(str, checks)))
        comparison = Comparison(subject, metrics, None if effort.apart else clock)
        conditions = {
            "regimes": NO_REGIMES,
            "command": shlex.join(["gsim3d", "profile", *sys.argv[2:]]),
            "machine": machine.facts(restored.device),
            "subject": _facts(subject),
            "self_check": [str(check) for check in checks],
            "not_turned": not_turned,
            "not_measured": not_measured,
        }

        def keep(n_rounds: int) -> None:
            """What is known so far, in case that the command is ended."""
            unfinished = {**conditions, "unfinished": f"ended after {n_rounds} of {effort.n_rounds} rounds"}
            report.write_numbers(out, report.as_dict(_in_time(points), comparison, unfinished, {"exact": points[0]}))

        measure(comparison, points, clock, effort, advance, limit, keep)
        if points[0].failure:
            raise InputError(f"{args.checkpoint}: the reference run has no result: {points[0].failure}")
        points = _in_time(points, not_turned)
        doing = "combinations for the presets"
        presets = autotune.tune(comparison, points, clock, effort, lambda what: advance(f"{doing}: {what}", 0), limit)
        points = list(dict.fromkeys([*points, *presets.values()]))
        advance("many scenes, training", REST // 2)
        conditions["regimes"] = _regimes(subject, presets, clock, quick, lambda: limit.is_over(REGIMES))
        advance("pictures", REST - REST // 2)
        content, files = report.write(out, points, comparison, conditions, presets, training)
    files.append(_keep_speeds(located(args.checkpoint), out, restored, presets, PartTimes.of(subject, points[0])))
    print(report.table(content))
    for name, point in presets.items():
        print(f"--speed {name}: {point.setting.name}, {1e3 * point.step_seconds:.2f} ms a step")
    print("written: " + ", ".join(str(path) for path in files))
    return 0 if all(check.holds for check in checks) else 1


def _facts(subject) -> dict:
    """What is measured, for the report."""
    restored = subject.restored
    return {
        "checkpoint": restored.checkpoint.digest,
        "scenes": len(subject.scenes),
        "steps": subject.n_steps,
        "image": f"{restored.image_size[0]} x {restored.image_size[1]} pixels",
        "views": len(subject.views[0][1]),
        "history": restored.data.history,
        "steps_a_call": {
            name: other.simulator.config.dynamics.steps_per_call
            for name, other in {"": restored, **subject.others}.items()
        },
    }


def _in_time(points: list, not_turned: dict | None = None) -> list:
    """Points that there was time for; what of the others' knobs was left out is added to ``not_turned``."""
    from gsim3d.profile.limit import LEFT_OUT

    for point in points:
        if not_turned is not None and point.failure == LEFT_OUT:
            before = not_turned.get(point.knob, "more time than --minutes gave, for ")
            not_turned[point.knob] = before + ", " * (not before.endswith(" ")) + point.setting.name
    return [point for point in points if point.failure != LEFT_OUT]


def _others(args: argparse.Namespace, earlier: dict) -> dict:
    """Checkpoints to draw beside this one: those named, and earlier ones of its run."""
    from pathlib import Path

    from gsim3d.errors import InputError
    from gsim3d.train.restore import restore

    named = {Path(given).name or str(given): given for given in args.others}
    if len(named) < len(args.others):
        raise InputError("--others: two have the same name; rename one")
    return {name: restore(given, args.device) for name, given in {**earlier, **named}.items()}


def _regimes(subject, presets: dict, clock, quick: bool, is_late) -> dict:
    """Many scenes at once, training, and what a GPU does; of that, what there is time for."""
    from gsim3d.profile import regimes, report

    on_cpu = subject.device.type == "cpu"
    hurried = quick and on_cpu
    kept = list(dict.fromkeys(point.setting for point in presets.values()))
    repeats = HURRIED_REPEATS if hurried else 20
    throughputs = [regimes.throughput(subject, setting, clock, repeats) for setting in kept if not is_late()]
    training = regimes.TrainingStep(problem="--minutes left no time")
    if not is_late():
        training = regimes.training_step(subject, clock, 1 if hurried else 3, hurried)
    work = [] if on_cpu else [(s.name, regimes.gpu_work(subject, s, clock)) for s in kept if not is_late()]
    return report.regimes_as_dict(throughputs, training, work)


def _keep_speeds(checkpoint, out, *kept):
    """Beside the checkpoint, where `gsim3d simulate --speed` looks; in ``out`` where nothing can be written there."""
    from gsim3d.profile import autotune

    try:
        return autotune.save_speeds(checkpoint if checkpoint.is_dir() else checkpoint.parent, *kept)
    except OSError as error:
        print(
            f"{error.filename or checkpoint}: {error.strerror}; copy {autotune.SPEEDS_FILE} there, for gsim3d simulate"
        )
        return autotune.save_speeds(out, *kept)


def _scenes(args: argparse.Namespace, restored, out, count: int | None) -> list:
    """Held-out scenes of DATA, or new ones."""
    quick = args.preset == "quick"
    from gsim3d.data import find_scenes, split_scenes

    if args.data is None:
        from gsim3d.synth import generate
        from gsim3d.synth.worlds import VALIDATION_SEED

        world, preset, options = _world(args.checkpoint, quick)
        if restored.fps is not None:
            options["fps"] = restored.fps
        folders = generate(
            out / "data",
            world,
            preset=preset,
            image_size=restored.image_size[0],
            n_trajectories=count,
            seed=VALIDATION_SEED,
            progress=not args.quiet,
            **options,
        ).folders
    else:
        folders = find_scenes(args.data)
        folders = folders if args.scenes == "all" else split_scenes(folders)[1] or folders
    return [restored.open_scene(folder) for folder in folders[:count]]


def _world(checkpoint: str, quick: bool) -> tuple[str, str, dict]:
    """(world, preset, options) of scenes as a simulator that comes with gsim3d saw them; of others, soft bodies."""
    import json

    from gsim3d.pretrained import FOLDER, located
    from gsim3d.synth.worlds import WORLDS

    path = located(checkpoint)
    if not path.is_relative_to(FOLDER) or not (recipe := path.parent / "recipe.json").is_file():
        return "elastic", "mini", {}
    world = json.loads(recipe.read_text())["world"]
    if world["world"] not in WORLDS:
        return "elastic", "mini", {}
    return world["world"], world["preset"], {"n_frames": min(QUICK_FRAMES, world["n_frames"])} if quick else {}
