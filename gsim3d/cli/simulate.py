"""``gsim3d simulate``: predict the future of one scene."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import whole
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP, add_fitting

EPILOG = """\
The scene's first steps are the input; the following ones are predicted, also beyond the end of the video. Written to
DIR: rollout.mp4 (truth above prediction, a column for each camera; VP9, plays in browsers), frames/ (predicted images
as PNG) and gaussians/step_0000.ply ... (3D Gaussians of every step, for viewers of 3D Gaussian splatting).

examples:
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/ball
  gsim3d simulate elastic-small data/elastic/ball/0000 --out runs/ball
  gsim3d simulate model.safetensors runs/data/ball/0000 --out runs/ball --steps 48 --cameras 2 7
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/thrown --edit edits.yaml

edits.yaml, a list (docs/reference/effects.md has all operations):
  - {step: 0, op: remove, of: frozen}                         no ground
  - {step: 8, op: throw, of: moving, velocity: [0, 0, 0.1]}   metres a step
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Predicts the future of one scene and writes it as video and as 3D Gaussians."
    parser.epilog = EPILOG
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    parser.add_argument("scene", metavar="SCENE", help="scene folder of any layout (docs/reference/data.md)")
    parser.add_argument("--out", metavar="DIR", required=True, help="folder to write; must not exist yet")
    parser.add_argument("--steps", type=whole(1), help="steps to predict (default: to the end of the video)")
    parser.add_argument("--start", type=whole(0), default=0, help="first input step (default: 0)")
    parser.add_argument(
        "--cameras", type=whole(0), nargs="+", metavar="CAM", help="cameras to show (default: up to 4 targets)"
    )
    parser.add_argument(
        "--context", type=whole(0), nargs="+", metavar="CAM", help="input cameras (default: spread evenly)"
    )
    add_fitting(parser)
    parser.add_argument("--html", action="store_true", help="also write player.html, which plays in any browser")
    parser.add_argument("--edit", metavar="FILE", help="YAML file of changes of the scene on the way")
    parser.add_argument("--effects", metavar="FILE", help="YAML file of what to compute (default: as in training)")
    parser.add_argument(
        "--speed",
        default="exact",
        metavar="PRESET",
        help="exact (default), or balanced or fast: tuned by gsim3d profile to keep 99.9 %% or 99 %% of the gain",
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    import os
    import shutil
    from dataclasses import replace
    from functools import partial

    import numpy as np

    from gsim3d.effects.edits import load_edits
    from gsim3d.effects.spec import EffectsSpec, OutputEffects, StructureEffects
    from gsim3d.errors import InputError
    from gsim3d.evaluate.pictures import as_bytes, comparison_frames, true_images, write_gaussians
    from gsim3d.evaluate.protocol import default_views, render_steps
    from gsim3d.io import write_video
    from gsim3d.io.files import new_output_path, write_picture
    from gsim3d.numerics.speed import load_speed
    from gsim3d.pretrained import located
    from gsim3d.profile.settings import Runner
    from gsim3d.train.restore import restore
    from gsim3d.viewer import write_player
    from gsim3d.viewer.player import View

    out = new_output_path(args.out)
    restored = restore(args.checkpoint, args.device)
    scene = restored.open_scene(args.scene, args.keep, args.resample)
    context, target = default_views(restored, scene, args.context)
    cams = args.cameras or list(target[:4])
    n_future = args.steps if args.steps is not None else max(1, scene.n_steps - args.start - restored.data.history)
    if bad := [cam for cam in (*cams, *context) if not 0 <= cam < scene.n_cams]:
        raise InputError(f"{scene.path}: camera {bad[0]} does not exist; the scene has {scene.n_cams}")
    spec = restored.plan.spec if args.effects is None else EffectsSpec.load(args.effects)
    edits = () if args.edit is None else load_edits(args.edit, partial(_encode, restored, args.resample))
    if edits:
        changes = (edit.operation for edit in edits)
        structure = StructureEffects(*map(any, zip(*((change.inserts, change.removes) for change in changes))))
        spec = replace(spec, structure=structure)
    restored = replace(restored, plan=restored.simulator.plan(replace(spec, outputs=OutputEffects())))
    checkpoint = located(args.checkpoint)
    folder = checkpoint if checkpoint.is_dir() else checkpoint.parent
    setting = load_speed(folder, restored.checkpoint.digest, args.device, args.speed)
    runner = Runner(restored, setting)
    with progress(None, "simulating", n_future, unit="step", quiet=args.quiet) as bar:
        prediction = runner.predict(scene, context, n_future, args.start, edits, bar.update)
    restored, first = replace(restored, simulator=runner.simulator, plan=runner.plan), args.start + runner.skipped
    steps = [prediction.particles.select_clouds([step]) for step in range(prediction.n_steps)]
    steps = progress(steps, "drawing", unit="step", quiet=args.quiet)
    images = [as_bytes(render_steps(restored, step, scene, cams, first + i))[0] for i, step in enumerate(steps)]
    images = np.stack(images)
    part = out.with_name(f".{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        (part / "frames").mkdir(parents=True)
        for step, views in enumerate(images):
            for cam, image in zip(cams, views, strict=True):
                write_picture(part / "frames" / f"cam_{cam}_{step:04d}.png", image)
        truth = true_images(scene, cams, range(first, first + len(images)))
        write_video(part / "rollout.mp4", comparison_frames(truth, images), scene.fps)
        write_gaussians(part / "gaussians", restored, prediction, scene.fps)
        if args.html:
            camera = scene.cameras_at(cams[:1], [first])
            write_player(
                part / "player.html",
                restored.simulator.renderer(prediction.particles).to("cpu"),
                fps=scene.fps,
                title=scene.name,
                view=View(camera.viewmats[0].numpy(), camera.Ks[0].numpy(), camera.width, camera.height),
                truth=truth[:, 0] if len(truth) == len(images) else None,
                start=prediction.n_encoded,
            )
        os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    rested = f" ({prediction.resting:.0%} of the particles at rest, not computed)" if prediction.resting else ""
    print(f"{prediction.n_encoded} steps encoded, {n_future} predicted{rested}; written: {out}")
    return 0


def _encode(restored, resample, folder):
    """The particles of another scene."""
    from gsim3d.evaluate.protocol import default_views, encode_steps

    scene = restored.open_scene(folder, resample=resample)
    return encode_steps(restored, scene, default_views(restored, scene)[0])
