"""gsim3d evaluate: measure predictions on a data set."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import whole
from gsim3d.pretrained import CHECKPOINT_HELP, FOLDER, add_fitting, located

EPILOG = """\
Every scene's first steps are given, all others predicted and compared with the film, seen from cameras that were no
input. Measured are psnr (all pixels), psnr_masked (without background), psnr_body (what may move), psnr_ground (the
rest), psnr_ring (ground near bodies, where shadows fall), ssim, lpips_alex, lpips_vgg and fvd, for

  model              this checkpoint
  constant           its last encoded particles, held still: what the learned dynamics adds
  copy               the true last given frame of the same camera: no model at all
  constant_velocity  its last encoded particles; what may move goes on as its centroid went last
  release_constant   its first predicted step, held still: the baseline of the published evaluation
  perfect_ground     constant, with the ground as it is in the film: what an exact ground alone would score (masked)
  perfect_body       constant, with the bodies as they are in the film (masked)

LPIPS and FVD need weights: run `gsim3d weights lpips` and `gsim3d weights fvd` once. Until then the report says that
they were not measured. FVD takes a second or two a clip on a CPU; --metrics leaves it out.

The validation and test sets are made by `gsim3d generate` with seeds 77 (24 trajectories) and 78 (56); of them all
scenes are scored. --against compares with another report on the same scenes: mean differences and their paired
standard errors; nothing below two of them is called better.

Other models, also those that know images only, are scored under the same conditions: put what they predict into
DIR/<scene folder as below DATA>/cam_<j>/<name>_<step>.png, or one video DIR/<scene folder>/cam_<j>.mp4, of the size of
the scene's images, and name DIR with --predictions. Without CHECKPOINT, --given says how many steps they were given.

Written: FILE.json (all numbers), and beside it .csv (scene, method, step), .md (tables like the paper's) and .png
(curves over time; needs matplotlib). docs/reference/evaluation.md defines every number.

examples:
  gsim3d evaluate runs/model runs/data
  gsim3d evaluate model.safetensors runs/data --scenes all --steps 16 --out metrics.json
  gsim3d evaluate elastic-small data/elastic-unseen --scenes all
  gsim3d evaluate runs/model runs/data --metrics psnr psnr_masked ssim lpips_vgg
  gsim3d evaluate runs/model runs/data --predictions video=runs/video_model
  gsim3d evaluate --predictions runs/video_model runs/data --given 4
  gsim3d evaluate runs/a/metrics.json --against runs/b/metrics.json
  torchrun --nproc-per-node 4 -m gsim3d evaluate runs/model runs/data --device cuda
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Measures how well a simulator predicts the scenes of a data set."
    parser.epilog = EPILOG
    parser.add_argument(
        "checkpoint",
        metavar="CHECKPOINT",
        nargs="?",
        help=f"{CHECKPOINT_HELP} (left out: only --predictions are scored)",
    )
    parser.add_argument(
        "data", metavar="DATA", help="folder with scenes, or one scene folder; a report, to compare it with --against"
    )
    parser.add_argument(
        "--predictions",
        metavar="[NAME=]DIR",
        action="append",
        default=[],
        help="predictions of another model to score; may be given several times",
    )
    parser.add_argument(
        "--given", type=whole(1), metavar="N", help="steps that the other models were given (no CHECKPOINT)"
    )
    parser.add_argument(
        "--scenes",
        choices=("test", "train", "all"),
        help="which part of the data set (default: test, the scenes that `gsim3d train` holds out; of the validation "
        "and test sets all)",
    )
    parser.add_argument(
        "--split",
        choices=("gsim3d", "published"),
        default="gsim3d",
        help="rule that holds scenes out (default: gsim3d; published: that of the released model, which leaks in small "
        "sets)",
    )
    parser.add_argument("--steps", type=whole(1), help="steps to predict (default: to the end of the shortest film)")
    parser.add_argument(
        "--cameras",
        type=whole(0),
        nargs="+",
        metavar="CAM",
        help="cameras to compare (default: those kept from the training's inputs; without CHECKPOINT all predicted)",
    )
    parser.add_argument(
        "--context", type=whole(0), nargs="+", metavar="CAM", help="input cameras (default: spread evenly)"
    )
    parser.add_argument(
        "--metrics", nargs="+", metavar="METRIC", help="what to measure (default: all whose weights are installed)"
    )
    parser.add_argument(
        "--clips", type=whole(2), default=48, metavar="N", help="clips of which FVD is measured, at most (default: 48)"
    )
    add_fitting(parser)
    parser.add_argument(
        "--against", metavar="FILE", help="compare with this report (metrics.json) of another model on the same scenes"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")
    parser.add_argument(
        "--out",
        metavar="FILE",
        help="JSON file (default: metrics.json beside the checkpoint's files, in the folder of the predictions, or, of "
        "a simulator that comes with gsim3d, in the current folder)",
    )


def run(args: argparse.Namespace) -> int:
    from gsim3d.errors import InputError
    from gsim3d.evaluate import compare
    from gsim3d.evaluate.scoring import measurable
    from gsim3d.train.processes import joined

    other = None if args.against is None else compare.read_report(args.against)
    if other is not None and args.checkpoint is None and not args.predictions:
        comparison = compare.compare(compare.read_report(args.data), other, args.against)
        print(compare.table(comparison, args.against))
        return 0
    metrics, not_measured = measurable(args.metrics)
    if args.checkpoint is None and not args.predictions:
        raise InputError("nothing to evaluate: name a CHECKPOINT, or predictions of other models with --predictions")
    if args.checkpoint is None and (args.given is None or args.given < 1):
        raise InputError("--given: without a CHECKPOINT, say how many steps the other models were given, at least 1")
    if args.checkpoint is not None and args.given is not None:
        raise InputError("--given: with a CHECKPOINT it is the model's own history; leave the option out")
    if args.checkpoint is None and (args.resample or args.keep):
        raise InputError("--resample and --keep fit scenes to a CHECKPOINT; without one leave them out")
    with joined(args.device) as processes:
        return _evaluate(args, metrics, not_measured, other, processes)


def _evaluate(args: argparse.Namespace, metrics: tuple, not_measured: dict, against: dict | None, processes) -> int:
    """Scores this process's share of the scenes; the first process gathers and writes."""
    from dataclasses import replace

    from gsim3d.errors import InputError
    from gsim3d.evaluate import compare
    from gsim3d.evaluate.predictions import Predictions
    from gsim3d.evaluate.protocol import default_views, horizon, score_scenes
    from gsim3d.evaluate.report import summarize, table
    from gsim3d.train.restore import restore

    restored = None if args.checkpoint is None else restore(args.checkpoint, args.device)
    others = [Predictions.open(given, args.data) for given in args.predictions]
    if len({other.name for other in others}) != len(others):
        raise InputError("--predictions: two have the same name; write NAME=DIR")
    out = _out_file(args, others)
    n_encoded = args.given if restored is None else restored.data.history
    scenes, found = _scenes(args, restored)
    views, n_future = [], args.steps
    for scene in scenes:
        if restored is None:
            context, targets = None, args.cameras or others[0].cameras(scenes[0])
        else:
            context, targets = default_views(restored, scene, args.context, args.cameras)
        if bad := [cam for cam in (*targets, *(context or ())) if not 0 <= cam < scene.n_cams]:
            raise InputError(f"{scene.path}: camera {bad[0]} does not exist; the scene has {scene.n_cams}")
        views.append((context, targets))
        n_future = min(horizon(scene, n_encoded, args.steps), n_future or scene.n_steps)
    for scene, (_, targets) in zip(scenes, views):
        for other in others:
            other.check(scene, targets, n_encoded, n_future)
    conditions = {"set": found, **_conditions(args, restored, others, scenes, views)}
    processes.check_agreement(**{"CHECKPOINT, DATA or options": (conditions, n_future, metrics)})
    if against is not None:
        names = [_name(scene, args.data) for scene in scenes]
        compare.check_same({"n_encoded_steps": n_encoded, "n_future_steps": n_future}, names, against, args.against)
    given = {"n_encoded": n_encoded, "n_future": n_future, "metrics": metrics, "others": others, "clips": args.clips}
    scores = score_scenes(restored, scenes, views, **given, processes=processes, quiet=False)
    if not processes.is_first:
        return 0
    scores = [replace(score, scene=_name(scene, args.data)) for score, scene in zip(scores, scenes, strict=True)]
    summary = {**conditions, **summarize(scores, not_measured)}
    print(table(summary))
    refused = None
    if against is not None:
        try:
            comparison = compare.compare(summary, against, args.against)
            summary["against"] = {"file": args.against, "checkpoint": against.get("checkpoint"), **comparison[""]}
            print(f"\n{compare.table(comparison, args.against)}")
        except InputError as error:  # the scores are written before it ends the command
            refused = error
    print("\nwritten: " + ", ".join(str(path) for path in _write(out, args, scenes, scores, summary)))
    if refused is not None:
        raise refused
    return 0


def _out_file(args: argparse.Namespace, others: list):
    from pathlib import Path

    from gsim3d.io.files import output_path

    if args.out:
        out = output_path(args.out, ".json")
    else:
        place = located(args.checkpoint) if args.checkpoint else Path(others[0].folder)
        shipped = place.is_relative_to(FOLDER)  # nothing is written into the package
        out = Path() / "metrics.json" if shipped else (place if place.is_dir() else place.parent) / "metrics.json"
    return out


def _scenes(args: argparse.Namespace, restored) -> tuple[list, dict | None]:
    """The chosen scenes, opened as the model expects them, and which set they are of."""
    from gsim3d.data import Scene, find_scenes, published_split, split_scenes
    from gsim3d.synth.held_out import set_of

    folders = find_scenes(args.data)
    found = set_of(folders)
    if args.scenes is None:
        args.scenes = "all" if found and found["name"] else "test"
    train, test = (split_scenes if args.split == "gsim3d" else published_split)(folders)
    chosen = {"all": folders, "train": train, "test": test or folders}[args.scenes]
    fitting = {"keep": args.keep, "resample": args.resample}
    scenes = [Scene.open(f) if restored is None else restored.open_scene(f, **fitting) for f in chosen]
    return scenes, set_of(chosen)


def _name(scene, root: str) -> str:
    """The scene's folder below the data set's: two scenes never share it."""
    below = scene.path.relative_to(root).as_posix()
    return scene.name if below == "." else below


def _conditions(args: argparse.Namespace, restored, others: list, scenes: list, views: list) -> dict:
    """What was evaluated, and on what: without it two reports cannot be compared."""
    return {
        "checkpoint": None if restored is None else restored.checkpoint.digest,
        "effects": None if restored is None else restored.plan.spec.hash,
        "predictions": {other.name: str(other.folder) for other in others},
        "data": str(args.data),
        "part": args.scenes,
        "split": args.split,
        "fps": sorted({scene.fps for scene in scenes}),
        "cameras": {
            _name(scene, args.data): {"context": None if context is None else list(context), "target": list(targets)}
            for scene, (context, targets) in zip(scenes, views)
        },
    }


def _write(out, args: argparse.Namespace, scenes: list, scores: list, summary: dict) -> list:
    """Writes the report in all its forms; returns the files."""
    from pathlib import Path

    from gsim3d.errors import InputError
    from gsim3d.evaluate.pictures import write_curves
    from gsim3d.evaluate.report import write_csv, write_json, write_markdown
    from gsim3d.io.files import with_parents

    with_parents(out)
    files = [out, out.with_suffix(".csv"), out.with_suffix(".md"), out.with_suffix(".png")]
    write_json(files[0], summary)
    write_csv(files[1], scores)
    write_markdown(files[2], summary, Path(args.data).absolute().name)
    rates = {scene.fps for scene in scenes}
    if not summary["by_step"]:
        return files[:3]
    try:
        write_curves(files[3], summary, rates.pop() if len(rates) == 1 else None)
    except InputError as error:
        print(f"no curves: {error}")
        files.pop()
    return files
