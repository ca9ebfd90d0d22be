#!/usr/bin/env python
"""Scores a simulator that comes with gsim3d, or is about to: held-out trajectories and sets over the full horizon.

    python tools/release/score.py elastic-small --data runs/held_out --out runs/scores --device cuda

    torchrun --nproc-per-node 4 tools/release/score.py elastic-small ...          # scenes dealt over 4 GPUs

Trajectories are made in DATA where they are not there: of the kind it was trained on (24 with the validation seed, or
with --held-out test 56 with the test seed), with unseen shapes, with several bodies, without ground, and on raised
ground. Written to OUT: NAME.scores.json, and NAME.frames.png, a trajectory of each set, truth above prediction. Of its
own kind LPIPS and FVD are measured, too, where their weights are installed. --sets measures some of the sets anew and
keeps what the file says of the others.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.errors import InputError  # noqa: E402

KIND = "held_out"  # of what it was trained on
OTHER_SETS = ("unseen", "several", "no-ground", "raised")
OTHERS = 7  # trajectories of each of them
SHOWN = 7  # frames of a trajectory in the picture


def score(
    checkpoint: str | Path,
    name: str,
    data: Path,
    out: Path,
    *,
    device: str,
    held_out: str = "validation",
    counts: tuple[int, int] | None = None,
    subsets: Sequence[str] = (),
    preset: str = "published",
    changes: Mapping = MappingProxyType({}),
) -> dict:
    """Writes and returns the scores of ``name``; in several processes the first one makes trajectories and writes.

    Args:
        checkpoint: its weights.
        name: world and size, such as elastic-small.
        data: folder of the trajectories; made if absent.
        out: folder of the scores.
        device: "cpu" or "cuda".
        held_out: "validation" or "test".
        counts: trajectories of its own kind, and of each other set; None: as many as the held-out set has, and OTHERS.
        subsets: to be measured; none: all that the world has.
        preset: of `gsim3d generate`.
        changes: of its options.
    """
    import cv2
    import numpy as np

    from gsim3d.evaluate.protocol import default_views, score_scenes
    from gsim3d.evaluate.report import summarize, write_json
    from gsim3d.evaluate.scoring import PLAIN_METRICS, measurable
    from gsim3d.synth import generate
    from gsim3d.synth.held_out import SETS, set_of
    from gsim3d.synth.worlds import HELD_OUT
    from gsim3d.train.processes import joined
    from gsim3d.train.restore import restore

    seed, count = SETS[held_out]
    counts = counts or (count, OTHERS)
    world = name.split("-")[0]
    file = out / f"{name}.{'' if held_out == 'validation' else f'{held_out}.'}scores.json"
    with joined(device) as processes:
        restored = restore(checkpoint, device)
        head = {"name": name, "checkpoint": restored.checkpoint.digest, "step": restored.checkpoint.state["step"]}
        sets, rows = {}, []
        if subsets and file.is_file():
            sets = json.loads(file.read_text())
            if sets["checkpoint"] != head["checkpoint"]:
                raise InputError(f"{file}: of other weights; measure all sets")
        for subset in subsets or (KIND, *(subset for subset in OTHER_SETS if world in HELD_OUT["diverse"][subset])):
            metrics, missing = measurable(None if subset == KIND else PLAIN_METRICS)
            place, count, begin = data / held_out / world / subset, counts[subset != KIND], time.monotonic()
            folders = None
            if processes.is_first:
                options = {**changes, **({} if subset == KIND else {"subset": subset})}
                folders = generate(place, world, preset=preset, n_trajectories=count, seed=seed, **options).folders
            folders = processes.gather(folders)[0]  # the others wait for the trajectories
            ready = time.monotonic()
            scenes = [restored.open_scene(folder) for folder in folders]
            views, n_encoded = [default_views(restored, scene) for scene in scenes], restored.data.history
            n_future = min(scene.n_steps for scene in scenes) - n_encoded
            given = {"n_encoded": n_encoded, "n_future": n_future, "metrics": metrics, "processes": processes}
            scores = score_scenes(restored, scenes, views, **given)
            if not processes.is_first:
                continue
            took = round(time.monotonic() - ready, 1)
            sets[subset] = {"seconds": took, "set": set_of(folders), **summarize(scores, missing)}
            if not subsets:
                rows += frames_of(restored, scenes[0], n_future)
            model, still = (sets[subset][f"{method}future.psnr_masked"] for method in ("", "constant."))
            seconds = f"simulated in {ready - begin:.0f} s, scored in {took:.0f} s"
            print(f"{subset}: {count}, {seconds}: masked {model:.2f} dB, constant {still:.2f} dB", flush=True)
        if processes.is_first:
            out.mkdir(parents=True, exist_ok=True)
            write_json(file, {**sets, **head})
        if processes.is_first and not subsets:
            picture = file.with_name(file.name.replace("scores.json", "frames.png"))
            cv2.imwrite(str(picture), np.concatenate(rows)[..., ::-1])
    return {**sets, **head}


def frames_of(restored, scene, n_future: int) -> list:
    """Two rows of frames [H, SHOWN W, 3] of a trajectory, truth above prediction."""
    import numpy as np

    from gsim3d.evaluate.pictures import as_bytes, true_images
    from gsim3d.evaluate.protocol import default_views, predict, render_steps

    context, target = default_views(restored, scene)
    prediction = predict(restored, scene, context, n_future)
    steps = np.linspace(prediction.n_encoded, prediction.n_steps - 1, SHOWN).round().astype(int).tolist()
    truth = true_images(scene, target[:1], steps)[:, 0]
    rendered = as_bytes(render_steps(restored, prediction.particles, scene, target[:1]))[steps, 0]
    return [np.concatenate(list(images), 1) for images in (truth, rendered)]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="world and size, such as elastic-small")
    parser.add_argument("--checkpoint", help="where its weights are (default: those that come with gsim3d)")
    parser.add_argument("--data", type=Path, required=True, help="folder of the trajectories; made if absent")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--held-out", choices=("validation", "test"), default="validation", help="the test set is for releases only"
    )
    parser.add_argument("--trajectories", type=int, nargs=2, metavar=("OWN", "OTHERS"), help="other numbers of them")
    parser.add_argument("--preset", default="published", help="of its trajectories (default: published)")
    parser.add_argument("--sets", nargs="+", choices=(KIND, *OTHER_SETS), default=(), help="default: all")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    args = parser.parse_args(arguments)
    given = {"held_out": args.held_out, "counts": args.trajectories, "subsets": args.sets, "preset": args.preset}
    score(args.checkpoint or args.name, args.name, args.data, args.out, device=args.device, **given)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"score: error: {error}")
