"""Predicts the future of one scene and writes it as video and as 3D Gaussians.

The scene's first steps are the input; the following ones are predicted, also beyond the end of the video. Written to
DIR: rollout.mp4 (truth above prediction, a column for each camera; H.264 with gsim3d[video], else VP9), frames/
(predicted images as PNG), gaussians/step_0000.ply ... (3D Gaussians of every step, for viewers of 3D Gaussian
splatting) and state.safetensors (the last steps as particles: gsim3d view DIR --checkpoint CHECKPOINT goes on).

examples:
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/ball
  gsim3d simulate elastic-small data/elastic/ball/0000 --out runs/ball
  gsim3d simulate model.safetensors runs/data/ball/0000 --out runs/ball --steps 48 --cameras 2 7
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/thrown --edit edits.yaml

edits.yaml, a list (docs/reference/effects.md has all operations):
  - {step: 0, op: remove, of: frozen}                         no ground
  - {step: 8, op: throw, of: moving, velocity: [0, 0, 0.1]}   metres a step
"""

import argparse

from gsim3d.cli.arguments import add_fitting, number, whole
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP

BOUND_HELP = "print from which step on the bound of the error exceeds this, and show the bound in rollout.mp4"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, cameras = parser.add_argument, {"type": whole(0), "nargs": "+", "metavar": "CAM"}
    add("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    add("scene", metavar="SCENE", help="scene folder of any layout (docs/reference/data.md)")
    add("--out", metavar="DIR", required=True, help="folder to write; must not exist yet")
    add("--steps", type=whole(1), help="steps to predict (default: to the end of the video)")
    add("--start", type=whole(0), default=0, help="first input step (default: 0)")
    add("--cameras", help="cameras to show (default: up to 4 targets)", **cameras)
    add("--context", help="input cameras (default: spread evenly)", **cameras)
    add_fitting(parser)
    add("--html", action="store_true", help="also write player.html, which plays in any browser")
    add("--max-error", type=number(0, above=True), metavar="METRES", help=BOUND_HELP)
    add("--edit", metavar="FILE", help="YAML file of changes of the scene on the way")
    add("--effects", metavar="FILE", help="YAML file of what to compute (default: as in training)")
    tuned = "exact (default), or balanced or fast: tuned by gsim3d profile to keep 99.9 %% or 99 %% of the gain"
    add("--speed", default="exact", metavar="PRESET", help=tuned)
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")
    add("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from gsim3d.effects.edits import load_edits, structure_of
    from gsim3d.effects.spec import EffectsSpec, OutputEffects
    from gsim3d.evaluate.pictures import write_prediction
    from gsim3d.evaluate.protocol import check_cameras, default_views, encode_folder, predict
    from gsim3d.io.files import new_output_path
    from gsim3d.numerics.trust import trust_of
    from gsim3d.train.restore import restore

    out = new_output_path(args.out)
    restored = restore(args.checkpoint, args.device, args.speed)
    scene = restored.open_scene(args.scene, args.keep, args.resample)
    context, target = default_views(restored, scene, args.context)
    cams = args.cameras or list(target[:4])
    check_cameras(scene, (*cams, *context))
    n_trained, simulator = restored.data.history, restored.simulator
    n_future = args.steps or max(1, scene.n_steps - args.start - n_trained)
    spec = restored.plan.spec
    if args.effects is not None:
        spec = simulator.setting.of_effects(EffectsSpec.load(args.effects), simulator.config.dynamics.is_asymmetric)
    edits = ()
    if args.edit is not None:
        edits = load_edits(args.edit, lambda folder: encode_folder(restored, folder, args.resample))
        spec = replace(spec, structure=structure_of(edits))
    restored = replace(restored, plan=simulator.plan(replace(spec, outputs=OutputEffects())))
    first = args.start + n_trained - restored.n_encoded
    trust = None if args.max_error is None else trust_of(simulator, args.checkpoint)
    with progress(None, "simulating", n_future, unit="step", quiet=args.quiet) as bar:
        options = {"start": first, "edits": edits, "on_steps": bar.update, "with_spread": trust is not None}
        prediction = predict(restored, scene, context, n_future, **options)
    bounds = None if trust is None else trust.bound(prediction.spread)
    write_prediction(out, restored, scene, prediction, cams, first, player=args.html, quiet=args.quiet, bounds=bounds)
    rested = f" ({prediction.resting:.0%} of the particles at rest, not computed)" if prediction.resting else ""
    print(f"{prediction.n_encoded} steps encoded, {n_future} predicted{rested}; written: {out}")
    if trust is not None:
        print(trust.verdict(bounds, prediction.step(prediction.n_encoded), args.max_error))
    return 0
