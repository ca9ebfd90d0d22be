"""Scene folders and the manifest of a generated data set.

Layout: OUT/<object>/<sample>/metadata.json, cam_<j>/{rgb,seg,inst,depth}_<step>.png, states.npz, actions.npz;
OUT/manifest.json; OUT/effects.yaml (see gsim3d.effects.spec). A scene is written to a hidden folder, which is renamed
when complete.
"""

import hashlib
import json
import os
import platform
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsim3d.errors import InputError, naming
from gsim3d.io.files import write_whole
from gsim3d.io.machine import processor_name, version_of
from gsim3d.io.plain import parse_json
from gsim3d.synth.cameras import Rig, workspace_origin
from gsim3d.synth.render import View

FILE_TEMPLATE = "cam_{cam_ix}/{img_type}_{n_step:04d}"
ACTIONS_FILE = "actions.npz"  # see gsim3d.data.actions
PNG_COMPRESSION = 3
DEPTH_UNIT = 1e-4  # unit of the 16-bit depth images in metres
MAX_DEPTH = 6.5  # largest depth in metres that fits
PACKAGES = ("numpy", "mujoco-core", "embreex", "trimesh", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class Scene:
    """A rendered trajectory."""

    object: str  #: name of the first body
    sample: int  #: index of the trajectory of this object
    fps: float  #: frames a second
    rig: Rig  #: cameras
    views: list[View]  #: images of every frame
    states: dict[str, np.ndarray]  #: name of a body or "cloth" -> nodes of its embedding, float32 [T, ..., 3] in metres
    extras: dict  #: additional keys of metadata.json, generator_version among them
    fingerprint: str  #: hash of the options that the scene depends on
    actions: np.ndarray | None = None  #: positions of the actors' points, float32 [T, A, 3] in metres; None: no actors
    action_types: tuple[str, ...] = ()  #: type of each point


def scene_folder(out: Path, name: str, sample: int) -> Path:
    """Folder of a trajectory in the data set ``out``."""
    return out / name / f"{sample:04d}"


def is_finished(folder: Path, fingerprint: str) -> bool:
    """Whether ``folder`` holds a finished scene. Raises InputError if it was generated with other options."""
    if not (folder / "metadata.json").is_file():
        return False
    if read_metadata(folder).get("fingerprint") != fingerprint:
        raise InputError(f"{folder} was generated with other options; choose another folder or remove it")
    return True


def read_metadata(folder: Path) -> dict:
    """Reads metadata.json of a scene. Raises InputError if it is invalid."""
    with naming(f"{folder / 'metadata.json'} cannot be read", (OSError, ValueError)):
        return parse_json((folder / "metadata.json").read_bytes())


def write_scene(out: Path, scene: Scene) -> Path:
    """Writes ``scene`` to its folder in ``out``, atomically."""
    folder = scene_folder(out, scene.object, scene.sample)
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    for leftover in (unfinished, folder):
        if leftover.exists():
            shutil.rmtree(leftover)
    unfinished.mkdir(parents=True)
    images_hash, states_hash = hashlib.sha256(), hashlib.sha256()
    for cam in range(scene.rig.n_cams):
        (unfinished / f"cam_{cam}").mkdir()
    for step, view in enumerate(scene.views):
        for image_type, images in _images(view):
            images_hash.update(np.ascontiguousarray(images).tobytes())
            for cam, image in enumerate(images):
                file = FILE_TEMPLATE.format(cam_ix=cam, img_type=image_type, n_step=step) + ".png"
                (unfinished / file).write_bytes(_png(image))
    for name, nodes in scene.states.items():
        states_hash.update(name.encode() + nodes.tobytes())
    np.savez(unfinished / "states.npz", **scene.states)
    if scene.actions is not None:
        np.savez(unfinished / ACTIONS_FILE, positions=scene.actions, types=np.array(scene.action_types))
    hashes = {"states_sha256": states_hash.hexdigest(), "images_sha256": images_hash.hexdigest()}
    write_whole(unfinished / "metadata.json", json.dumps({**_metadata(scene), **hashes}, indent=1) + "\n")
    os.replace(unfinished, folder)
    return folder


def _images(view: View) -> list[tuple[str, np.ndarray]]:
    """Type and pixels [V, H, W, ...] of the images of a step, in the order of hashing."""
    images = [("rgb", view.rgb[..., ::-1]), ("seg", view.segmentation), ("inst", view.instances)]
    if view.depth is not None:
        images.append(("depth", np.rint(view.depth / DEPTH_UNIT).astype(np.uint16)))
    return images


def _png(image: np.ndarray) -> bytes:
    done, data = cv2.imencode(".png", np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
    if not done:
        raise RuntimeError("OpenCV could not encode a PNG")
    return data.tobytes()


def _metadata(scene: Scene) -> dict:
    rig = scene.rig
    cams = {
        f"cam_{cam}": {
            "extrinsics": rig.viewmats[cam].tolist(),
            "intrinsics": rig.Ks[cam].tolist(),
            "resolution": [rig.size, rig.size],
        }
        for cam in range(rig.n_cams)
    }
    return {
        "n_steps": len(scene.views),
        "n_cams": rig.n_cams,
        "file_path_template": FILE_TEMPLATE,
        "fps": scene.fps,
        "near": rig.near,
        "far": rig.far,
        "origin": workspace_origin(rig).tolist(),
        "object": scene.object,
        "sample": scene.sample,
        "generator_version": scene.extras["generator_version"],
        "fingerprint": scene.fingerprint,
        **({} if scene.views[0].depth is None else {"depth_unit": DEPTH_UNIT}),
        **scene.extras,
        **cams,
    }


def write_manifest(out: Path, folders: list[Path], settings: dict) -> dict:
    """Writes OUT/manifest.json: options, hashes of all scenes, rejected draws, machine and versions."""
    scenes = {}
    for folder in folders:
        metadata = read_metadata(folder)
        scenes[folder.relative_to(out).as_posix()] = {
            key: metadata[key] for key in ("states_sha256", "images_sha256", "fingerprint", "attempt")
        }
    manifest = {
        "generator_version": metadata["generator_version"],
        "settings": settings,
        "machine": {"processor": processor_name(), "system": platform.platform(), "python": platform.python_version()},
        "versions": {package: version_of(package) or "absent" for package in PACKAGES},
        "rejected": rejected_draws(folders),
        "scenes": scenes,
    }
    write_whole(out / "manifest.json", json.dumps(manifest, indent=1) + "\n")
    return manifest


def rejected_draws(folders: list[Path]) -> dict[str, int]:
    """Reason -> number of rejected draws."""
    return dict(Counter(reason for folder in folders for reason in read_metadata(folder)["rejected"]))
