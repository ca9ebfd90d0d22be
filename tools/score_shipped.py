#!/usr/bin/env python
"""Scores a simulator that comes with gsim3d, or is about to: held-out trajectories and sets over the full horizon.

    python tools/score_shipped.py elastic-small --data runs/held_out --out runs/scores --device cuda

Trajectories are made in DATA where they are not there: of the kind it was trained on (another seed), with unseen
shapes, with several bodies, without ground, and on raised ground. Written to OUT: NAME.scores.json, and
NAME.frames.png, a trajectory of each set, truth above prediction. Of its own kind LPIPS and FVD are measured, too,
where their weights are installed. --sets measures some of the sets anew and keeps what the file says of the others.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.errors import InputError  # noqa: E402

KIND = "held_out"  # of what it was trained on
SETS = ("unseen", "several", "no-ground", "raised")
SHOWN = 7  # frames of a trajectory in the picture
TOGETHER = 7  # trajectories that are predicted at the same time


def score(
    checkpoint: str | Path,
    name: str,
    data: Path,
    out: Path,
    *,
    device: str,
    counts: tuple[int, int],
    subsets: Sequence[str] = (),
    preset: str = "published",
    changes: Mapping = MappingProxyType({}),
) -> dict:
    """Writes and returns the scores of ``name``.

    Args:
        counts: trajectories of its own kind, and of each other set.
        subsets: to be measured; none: all that the world has.
        preset: of `gsim3d generate`.
        changes: of its options.
    """
    import cv2
    import numpy as np

    from gsim3d.evaluate.protocol import predict_together, score_scene
    from gsim3d.evaluate.report import summarize, write_json
    from gsim3d.evaluate.scoring import PLAIN_METRICS, measurable
    from gsim3d.generate import generate
    from gsim3d.generate.worlds import HELD_OUT, VALIDATION_SEED
    from gsim3d.train.restore import restore

    restored = restore(checkpoint, device)
    world = name.split("-")[0]
    file = out / f"{name}.scores.json"
    head = {"name": name, "checkpoint": restored.checkpoint.digest, "step": restored.checkpoint.state["step"]}
    sets, rows = {}, []
    if subsets and file.is_file():
        sets = json.loads(file.read_text())
        if sets["checkpoint"] != head["checkpoint"]:
            raise InputError(f"{file}: of other weights; measure all sets")
    for subset in subsets or (KIND, *(subset for subset in SETS if world in HELD_OUT["diverse"][subset])):
        metrics, missing = measurable(None if subset == KIND else PLAIN_METRICS)
        begin = time.monotonic()
        count = counts[0] if subset == KIND else counts[1]
        options = {**changes, **({} if subset == KIND else {"subset": subset})}
        made = generate(
            data / world / subset, world, preset=preset, n_trajectories=count, seed=VALIDATION_SEED, **options
        )
        filmed, scores = time.monotonic(), []
        scenes = [restored.open_scene(folder) for folder in made.folders]
        n_future = min(scene.n_steps for scene in scenes) - restored.data.history
        for first in range(0, len(scenes), TOGETHER):
            some = scenes[first : first + TOGETHER]
            for scene, prediction in zip(some, predict_together(restored, some, n_future), strict=True):
                if not scores:
                    rows += frames_of(restored, scene, prediction)
                scores.append(score_scene(restored, scene, n_future=n_future, metrics=metrics, prediction=prediction))
        sets[subset] = {"seconds": round(time.monotonic() - filmed, 1), **summarize(scores, missing)}
        seconds = f"filmed in {filmed - begin:.0f} s, scored in {sets[subset]['seconds']:.0f} s"
        model, still = (sets[subset][f"{method}future.psnr_masked"] for method in ("", "constant."))
        print(f"{subset}: {count}, {seconds}: masked {model:.2f} dB, constant {still:.2f} dB", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    write_json(file, {**sets, **head})
    if not subsets:
        cv2.imwrite(str(out / f"{name}.frames.png"), np.concatenate(rows)[..., ::-1])
    return {**sets, **head}


def frames_of(restored, scene, prediction) -> list:
    """Two rows of frames [H, SHOWN W, 3] of a trajectory, truth above prediction."""
    import numpy as np

    from gsim3d.evaluate.pictures import as_bytes, true_images
    from gsim3d.evaluate.protocol import default_views, render_steps

    target = default_views(restored, scene)[1][:1]
    steps = np.linspace(prediction.n_encoded, prediction.n_steps - 1, SHOWN).round().astype(int).tolist()
    truth = true_images(scene, target, steps)[:, 0]
    rendered = as_bytes(render_steps(restored, prediction.particles, scene, target))[steps, 0]
    return [np.concatenate(list(images), 1) for images in (truth, rendered)]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="world and size, such as elastic-small")
    parser.add_argument("--checkpoint", help="where its weights are (default: those that come with gsim3d)")
    parser.add_argument("--data", type=Path, required=True, help="folder of the trajectories; made if absent")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--trajectories", type=int, nargs=2, default=(14, 7), metavar=("OWN", "OTHERS"))
    parser.add_argument("--preset", default="published", help="of its trajectories (default: published)")
    parser.add_argument("--sets", nargs="+", choices=(KIND, *SETS), default=(), help="default: all")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    args = parser.parse_args(arguments)
    counts = tuple(args.trajectories)
    given = {"device": args.device, "counts": counts, "subsets": args.sets, "preset": args.preset}
    score(args.checkpoint or args.name, args.name, args.data, args.out, **given)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"score_shipped: error: {error}")
