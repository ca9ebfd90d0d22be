"""What is measured: a simulator, scenes that it has not seen, and other checkpoints to draw beside it."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import cached_property

import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import default_views, horizon
from gsim3d.profile.runner import Runner
from gsim3d.profile.settings import Setting
from gsim3d.state import Particles
from gsim3d.train.restore import Restored

MOST_KEPT = 8  # encoded scenes


class Subject:
    """A simulator and scenes.

    Args:
        scenes: with the same cameras.
        n_steps: to predict; default to the end of the shortest film.
        others: other checkpoints by name: settings of knobs that need training.
    Raises:
        InputError: scenes do not fit a model, or another one needs more given steps than this one.
    """

    def __init__(
        self,
        restored: Restored,
        scenes: Sequence[Scene],
        n_steps: int | None = None,
        others: Mapping[str, Restored] | None = None,
    ):
        self.restored, self.scenes, self.others = restored, list(scenes), dict(others or {})
        self.first = restored.data.history
        for name, other in {"": restored, **self.others}.items():
            for scene in self.scenes:
                other.check_scene(scene)
            if other.data.history > self.first:
                raise InputError(
                    f"{name}: sees {other.data.history} given steps, the reference {self.first}: others must not see "
                    "more; make it the reference"
                )
        self.views = [default_views(restored, scene) for scene in self.scenes]
        self.n_steps = min(horizon(scene, self.first, None) for scene in self.scenes)
        self.n_steps = min(self.n_steps, n_steps or self.n_steps)
        self._runners: dict[Setting, Runner] = {}
        self._encoded: OrderedDict[tuple[Setting, int], Particles] = OrderedDict()

    @property
    def device(self) -> torch.device:
        return self.restored.device

    @cached_property
    def knob_of_other(self) -> dict[str, str]:
        """The knob that each of the others is a setting of."""
        mine, found = self.restored.simulator.config, {}
        for name, other in self.others.items():
            config = other.simulator.config
            if config == mine:
                found[name] = "training steps"
            elif config.dynamics.steps_per_call != mine.dynamics.steps_per_call:
                found[name] = "steps a call"
            else:
                found[name] = "model size"
        return found

    def runner(self, setting: Setting = Setting()) -> Runner:
        """The same one whenever it is asked for, so that what is compiled stays so."""
        if setting not in self._runners:
            restored = self.restored if setting.checkpoint is None else self.others[setting.checkpoint]
            self._runners[setting] = Runner(restored, setting)
        return self._runners[setting]

    def frames(self, runner: Runner, number: int):
        """What ``runner`` encodes of scene ``number``: the steps before the first predicted one."""
        scene, (context, targets) = self.scenes[number], self.views[number]
        if runner.restored is not self.restored:
            context, _ = default_views(runner.restored, scene, target=targets)
        return runner.frames([scene], [context], self.first - runner.restored.data.history)

    def start(self, runner: Runner, number: int) -> Particles:
        """The encoded state of scene ``number``, as ``runner`` simulates it. The last few are kept."""
        key = runner.setting.given, number
        if key not in self._encoded:
            self._encoded[key] = runner.seen(self.frames(runner, number))
            while len(self._encoded) > MOST_KEPT:
                self._encoded.popitem(last=False)
        self._encoded.move_to_end(key)
        return runner.chosen(self._encoded[key])

    def cameras(self, number: int, step: int) -> Cameras:
        """The target views of scene ``number`` at predicted step ``step``, counted from 0."""
        scene, (_, targets) = self.scenes[number], self.views[number]
        return scene.cameras_at(list(targets), [self.first + step]).to(self.device)

    def cameras_of(self, numbers: Sequence[int], step: int) -> Cameras:
        """The target views of several scenes, cloud after cloud."""
        parts = [self.cameras(number, step) for number in numbers]
        tensors = {
            name: torch.cat([getattr(part, name) for part in parts]) for name in ("viewmats", "Ks", "near", "far")
        }
        clouds = torch.cat([part.image_cloud + cloud for cloud, part in enumerate(parts)])
        return dataclasses.replace(parts[0], image_cloud=clouds, **tensors)

    def truth(self, number: int, steps: Sequence[int]) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Of predicted steps: images [S, V, H, W, 3] in [0, 1], labels uint8 [S, V, H, W] where there are any, and the
        pixels that were filmed, None for all."""
        scene, targets = self.scenes[number], list(self.views[number][1])
        filmed = [self.first + step for step in steps]
        images = scene.images(targets, filmed).permute(0, 1, 3, 4, 2).to(self.device).float() / 255
        labels = scene.segmentation(targets, filmed).to(self.device) if scene.has_segmentation() else None
        valid = scene.valid(targets, filmed)
        return images, labels, None if valid is None else valid.to(self.device)
