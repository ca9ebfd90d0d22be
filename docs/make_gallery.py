"""Makes the videos and posters of the gallery: every shipped simulator, every edit and an orbit.

python docs/make_gallery.py                        all; videos and scenes in docs/_build/gallery, minutes on 2 cores
python docs/make_gallery.py --only throw --out DIR --posters DIR

It needs pip install 'gsim3d[generate]'; with gsim3d[video] videos are H.264. A scene that is there already is kept.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

from gsim3d import pretrained  # noqa: E402
from gsim3d.data import Scene  # noqa: E402
from gsim3d.effects.edits import (  # noqa: E402
    Duplicate,
    Edit,
    Insert,
    Move,
    Operation,
    Recolor,
    Remove,
    Rotate,
    Throw,
    structure_of,
)
from gsim3d.evaluate.pictures import as_bytes, true_images, write_gaussians  # noqa: E402
from gsim3d.evaluate.protocol import default_views, encode_folder, predict, render_steps  # noqa: E402
from gsim3d.io import write_video  # noqa: E402
from gsim3d.io.files import write_whole  # noqa: E402
from gsim3d.io.orbit import orbit_frames  # noqa: E402
from gsim3d.io.sequence import open_sequence  # noqa: E402
from gsim3d.state import Particles  # noqa: E402
from gsim3d.synth import generate  # noqa: E402
from gsim3d.train.restore import Restored, restore  # noqa: E402
from gsim3d.viewer.clips import ACCENT, GAP, WHITE, clip_frames, write_text, write_time  # noqa: E402
from gsim3d.viewer.export import write_frames  # noqa: E402

Rows = dict[str, np.ndarray]  # label -> images uint8 [S, V, H, W, 3]
# preset of the training -> world -> what falls, and what is inserted
BODY = {
    "diverse": {"elastic": "star", "cloth": "blob", "rigid": "capsule", "insert": "ball"},
    "published": {"elastic": "spot", "cloth": "blob", "rigid": "capsule", "insert": "blob"},
}
SEED = 11  # of the scenes; none of the seeds of training
EDITED, EDIT_STEPS, AT = "elastic-small", 56, 6  # simulator, predicted steps and step of the edits
INSTANTS, TILE, QUALITY = 4, 256, 76  # of a poster: moments, pixels of each, JPEG quality
TURNS = 0.5  # of the camera of the orbit
LARGEST = 100_000  # bytes of a poster


def edits(other: Particles | None = None) -> dict[str, Operation]:
    """Name -> an edit of the elastic scene; ``other`` are the particles of another one, for "insert"."""
    return {
        "remove": Remove("frozen"),
        "move": Move("frozen", (0.0, 0.0, 0.25)),
        "rotate": Rotate("moving", (1.0, 0.0, 0.0), 90.0),
        "throw": Throw("moving", (0.004, 0.0, 0.07)),
        "recolor": Recolor("moving", (0.9, 0.15, 0.1)),
        "duplicate": Duplicate("moving", (0.0, 0.75, 0.2)),
        "insert": Insert("moving", particles=other, by=(0.0, -0.75, 0.3)),
    }


def scene_of(world: str, out: Path, frames: int | None, body: str | None = None) -> Path:
    """The folder of a scene of the preset that the simulator of the world was trained on; ``body``: a key of BODY."""
    recipe = json.loads((pretrained.FOLDER / f"{world}-small" / "recipe.json").read_text())
    preset = recipe["world"]["preset"]
    body = BODY[preset][body or world]
    changes = {} if frames is None else {"n_frames": frames}
    options = {"preset": preset, "seed": SEED, "n_trajectories": 1, "objects": (body,), **changes}
    return generate(out / "scenes" / f"{world}-{body}", world, processes=1, progress=False, **options).folders[0]


def drawn(restored: Restored, scene: Scene, n_views: int, n_future: int, edit: Edit | None = None):
    """The prediction, its images and the true ones, of the first target cameras."""
    given = () if edit is None else (edit,)
    spec = dataclasses.replace(restored.plan.spec, structure=structure_of(given))
    restored = dataclasses.replace(restored, plan=restored.simulator.plan(spec))
    context, targets = default_views(restored, scene)
    prediction = predict(restored, scene, context, n_future, edits=given)
    cams = targets[:n_views]
    images = as_bytes(render_steps(restored, prediction.particles, scene, cams))
    return prediction, images, true_images(scene, cams, range(prediction.n_steps))


def poster(path: Path, rows: Rows, fps: float, first: int) -> None:
    """Writes a JPEG of the first view: a row a label, a column for each of INSTANTS moments from step ``first``."""
    n_steps = len(next(iter(rows.values())))
    steps = np.linspace(min(first, n_steps - 1), n_steps - 1, INSTANTS).round().astype(int)
    canvas = np.full((len(rows) * (TILE + GAP) - GAP, INSTANTS * (TILE + GAP) - GAP, 3), 255, np.uint8)
    for i, (label, images) in enumerate(rows.items()):
        for j, step in enumerate(steps):
            tile = canvas[i * (TILE + GAP) :, j * (TILE + GAP) :][:TILE, :TILE]
            tile[:] = cv2.resize(images[step, 0], (TILE, TILE), interpolation=cv2.INTER_AREA)
            if images[step, 0].shape[0] < TILE:
                tile[:] = cv2.resize(images[step, 0], (TILE, TILE), interpolation=cv2.INTER_CUBIC)
            if j == 0 and label:
                write_text(tile, label, ACCENT if i else WHITE)
            if i == 0:
                write_time(tile, int(step), fps)
    write_whole(path, cv2.imencode(".jpg", canvas[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())
    if path.stat().st_size > LARGEST:
        sys.exit(f"{path} has {path.stat().st_size} bytes; lower QUALITY or TILE")


def of_simulators(out: Path, frames: int | None) -> Iterator[tuple[str, Callable[[], tuple[Rows, float, int]]]]:
    """(name, what gives rows, rate and given steps) of every shipped simulator."""
    for name in pretrained.names():

        def made(name=name):
            restored = restore(name)
            scene = restored.open_scene(scene_of(name.partition("-")[0], out, frames))
            prediction, images, truth = drawn(restored, scene, 2, scene.n_steps - restored.data.history)
            return {"truth": truth, "predicted": images}, scene.fps, prediction.n_encoded

        yield name, made


def of_edits(out: Path, frames: int | None) -> Iterator[tuple[str, Callable[[], tuple[Rows, float, int]]]]:
    """The same of every edit: the scene as it was, and edited."""
    known = {}

    def base():
        if not known:
            restored = restore(EDITED)
            scene = restored.open_scene(scene_of("elastic", out, frames))
            n_future = min(EDIT_STEPS, scene.n_steps - restored.data.history)
            known["made"] = restored, scene, n_future, drawn(restored, scene, 1, n_future)[:2]
        return known["made"]

    for name in edits():

        def made(name=name):
            restored, scene, n_future, (prediction, before) = base()
            other = encode_folder(restored, scene_of("elastic", out, frames, "insert")) if name == "insert" else None
            operation = edits(other)[name]
            _, after, _ = drawn(restored, scene, 1, n_future, Edit(min(AT, n_future - 1), operation))
            return {"as it was": before, name: after}, scene.fps, prediction.n_encoded

        yield name, made


def orbit(out: Path, posters: Path, frames: int | None) -> None:
    """The video and poster of a camera that circles around a prediction."""
    restored = restore(EDITED)
    scene = restored.open_scene(scene_of("elastic", out, frames))
    prediction = drawn(restored, scene, 1, min(EDIT_STEPS, scene.n_steps - restored.data.history))[0]
    clip = out / "orbit.mp4"
    write_gaussians(out / "orbit", restored, prediction, scene.fps)
    clip.unlink(missing_ok=True)
    frames = open_sequence(out / "orbit")
    write_frames(clip, frames, len(frames), fps=frames.fps, turns=TURNS)
    images = np.stack(list(orbit_frames(frames, len(frames), TILE, TURNS)))[:, None]
    poster(posters / "orbit.jpg", {"": images}, scene.fps, 0)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS / "_build" / "gallery", help="folder of videos and scenes")
    parser.add_argument("--posters", type=Path, default=DOCS / "results" / "gallery", help="folder of posters")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="simulators, edits, or orbit")
    parser.add_argument("--frames", type=int, help="steps of the scenes (default: as in training)")
    args = parser.parse_args()
    args.posters.mkdir(parents=True, exist_ok=True)
    pieces = dict([*of_simulators(args.out, args.frames), *of_edits(args.out, args.frames)])
    if unknown := sorted(set(args.only or ()) - {*pieces, "orbit"}):
        parser.error(f"no such piece: {', '.join(unknown)}; there are {', '.join([*pieces, 'orbit'])}")
    for name, made in pieces.items():
        if args.only is None or name in args.only:
            rows, fps, n_given = made()
            write_video(args.out / f"{name}.mp4", clip_frames(rows, fps, n_given), fps)
            poster(args.posters / f"{name}.jpg", rows, fps, n_given)
            print(args.out / f"{name}.mp4", flush=True)
    if args.only is None or "orbit" in args.only:
        orbit(args.out, args.posters, args.frames)
        print(args.out / "orbit.mp4")


if __name__ == "__main__":
    main()
