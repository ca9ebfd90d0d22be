"""Packing of images of scenes into Frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from gsim3d.cameras import Frames
from gsim3d.data.recording import BACKGROUND, MOVING
from gsim3d.errors import InputError
from gsim3d.state import Actions

if TYPE_CHECKING:
    from gsim3d.data.scene import Scene


def make_frames(
    scenes: Sequence[Scene], cams_per_scene: Sequence, steps_per_scene: Sequence, *, masked: bool | None = None
) -> Frames:
    """Packs the images of the given cameras and steps into one batch of Frames.

    Clouds are sorted by (scene, step). ``cloud_step`` counts the steps of each scene from 0.

    Args:
        scenes: one or more scenes of equal image size; a scene may appear twice.
        cams_per_scene: camera indices of each scene: one list for all steps, or one list per step.
        steps_per_scene: ascending step indices of each scene.
        masked: read the labels: ``masks`` is the foreground and ``dynamic`` the movable bodies. If False, ``masks``
            excludes only pixels without a recorded value (padding, borders of undistorted images). Default: True if
            all scenes have labels.

    Raises:
        InputError: a file is missing, an index is out of range, or image sizes differ.
    """
    if not (len(scenes) == len(cams_per_scene) == len(steps_per_scene)) or not len(scenes):
        raise InputError(
            "make_frames needs one or more scenes, with one list of cameras and one of steps for each; "
            f"got {len(scenes)} scenes, {len(cams_per_scene)} and {len(steps_per_scene)} lists"
        )
    masked = all(scene.has_segmentation() for scene in scenes) if masked is None else masked
    images, labels, valid, cameras, cloud_scene, cloud_step, image_cloud = [], [], [], [], [], [], []
    for number, (scene, cams, steps) in enumerate(zip(scenes, cams_per_scene, steps_per_scene)):
        first = scenes[0]
        if (scene.width, scene.height) != (first.width, first.height):
            raise InputError(
                f"{scene.path} has images of {scene.width}x{scene.height} pixels, {first.path} of "
                f"{first.width}x{first.height}; all scenes of a batch must have one size"
            )
        steps = [int(s) for s in steps]
        if any(b <= a for a, b in zip(steps, steps[1:])):
            raise InputError(f"{scene.path}: steps must ascend; got {steps}")
        for slot, (step, chosen) in enumerate(zip(steps, _cams_per_step(cams, len(steps), scene))):
            images.append(scene.images(chosen, [step])[0])
            if masked:
                labels.append(scene.segmentation(chosen, [step])[0])
            valid.append(scene.valid(chosen, [step]))
            cameras.append(scene.cameras_at(chosen, [step]))
            image_cloud += [len(cloud_scene)] * len(chosen)
            cloud_scene.append(number)
            cloud_step.append(slot)
    if not images:
        raise InputError("make_frames needs at least one step")
    labels = torch.cat(labels) if masked else None
    whole = (torch.ones_like(of_cloud[:, 0], dtype=torch.bool) for of_cloud in images)
    joint = torch.cat([of_all if one is None else one[0] for one, of_all in zip(valid, whole)])
    valid = None if bool(joint.all()) else joint
    offsets = np.stack([scene.world_offset for scene in scenes])
    joined = {name: torch.cat([getattr(c, name) for c in cameras]) for name in ("viewmats", "Ks", "near", "far")}
    joined["image_cloud"] = torch.tensor(image_cloud, dtype=torch.int64)
    return Frames(
        images=torch.cat(images).float().div_(255),
        cameras=dataclasses.replace(cameras[0], **joined),
        cloud_scene=torch.tensor(cloud_scene, dtype=torch.int64),
        cloud_step=torch.tensor(cloud_step, dtype=torch.int64),
        origin=torch.from_numpy(np.stack([scene.origin for scene in scenes])),
        masks=labels != BACKGROUND if masked else valid,
        dynamic=labels == MOVING if masked else None,
        valid=valid,
        world_offset=torch.from_numpy(offsets) if offsets.any() else None,
        actions=_join_actions(scenes, steps_per_scene),
    )


def _join_actions(scenes: Sequence[Scene], steps_per_scene: Sequence) -> Actions | None:
    """Returns the actions at the given steps and at all later ones of each scene; None if no scene has actors."""
    recorded = [scene.recording.actions for scene in scenes]
    known = [actions for actions in recorded if actions is not None]
    if not known:
        return None
    names = tuple(sorted({name for actions in known for name in actions.types}))
    steps = [[*map(int, s), *range(int(s[-1]) + 1, scene.n_steps)] for s, scene in zip(steps_per_scene, scenes)]
    shape = len(scenes), max(map(len, steps)), max(len(actions.types) for actions in known)
    positions, types = torch.zeros(*shape, 3), torch.full(shape, -1)
    for number, actions in enumerate(recorded):
        if actions is not None:
            at = steps[number] + [steps[number][-1]] * (shape[1] - len(steps[number]))
            positions[number, :, : len(actions.types)] = torch.from_numpy(actions.positions[at])
            given = torch.tensor([names.index(name) for name in actions.types])
            types[number, :, : len(given)] = torch.where(torch.from_numpy(actions.present[at]), given, -1)
    return Actions(positions, types, names)


def _cams_per_step(cams, n_steps: int, scene: Scene) -> list[list[int]]:
    cams = [list(c) if isinstance(c, (list, tuple, range, np.ndarray)) else c for c in cams]
    if cams and isinstance(cams[0], list):
        if len(cams) != n_steps:
            raise InputError(f"{scene.path}: cameras are given for {len(cams)} steps, but there are {n_steps}")
        return [[int(c) for c in step_cams] for step_cams in cams]
    return [[int(c) for c in cams]] * n_steps
