"""Building of simulators from training configurations and checkpoints, and fitting of scenes to them."""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from gsim3d import presets
from gsim3d.compat.checkpoints import SWITCHES, current_data, current_model
from gsim3d.compat.released_model import ReleasedModelConfig, ReleasedSimulator, simulator_class
from gsim3d.data import Scene
from gsim3d.data.fitting import SIMILAR, check_rate
from gsim3d.effects.plan import Plan
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import FitWarning, InputError, did_you_mean, naming
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.io.files import shown
from gsim3d.io.settings import from_dict, to_dict, upgraded
from gsim3d.presets import ModelConfig
from gsim3d.pretrained import KEEP, loading
from gsim3d.simulator import Simulator
from gsim3d.train.config import DataConfig, TrainConfig

PRESETS = ("tiny", "small", "paper_latent", "paper_explicit")


@dataclass(frozen=True)
class Restored:
    """A trained simulator with its training settings."""

    simulator: Simulator  #: the simulator in evaluation mode
    data: DataConfig  #: data settings of the training
    plan: Plan  #: plan of the effects that it was trained with
    checkpoint: Checkpoint  #: its checkpoint

    @property
    def image_size(self) -> tuple[int, int]:
        """Image size of the training, (width, height) in pixels."""
        return tuple(self.simulator.inputs.image_size)

    @property
    def fps(self) -> float | None:
        """Frames per second of the training scenes; None if unknown."""
        return self.simulator.inputs.fps

    @property
    def n_encoded(self) -> int:
        """Number of input steps: that of the training, or fewer if the simulator's setting reduces it."""
        return self.simulator.inputs.history

    @property
    def device(self) -> torch.device:
        """Device of the simulator."""
        return next(self.simulator.parameters()).device

    def open_scene(self, folder: str | Path, keep: Sequence[str] = (), resample: bool = False) -> Scene:
        """Opens a scene, fitted to the model; emits a :class:`gsim3d.errors.FitWarning` about changes.

        Args:
            folder: scene folder.
            keep: parts of KEEP to preserve: "image" scales images into the model's size instead of cropping them;
                "depth" keeps the scene's near and far, which are otherwise replaced by those of the training if they
                differ by at most a factor of SIMILAR.
            resample: subsample the scene to the model's frame rate, which must divide its own.

        Raises:
            InputError: as :meth:`check_scene` and the reader, or ``keep`` has an unknown part.
        """
        if unknown := [part for part in keep if part not in KEEP]:
            raise InputError(f"keep must contain only {', '.join(KEEP)}; got {unknown[0]!r}")
        exact = isinstance(self.simulator.config, ReleasedModelConfig)
        fitting = dataclasses.replace(
            self.data.fitting, slack=math.inf if exact else SIMILAR, enlarge=True, whole="image" in keep
        )
        if "depth" in keep:
            fitting = dataclasses.replace(fitting, near_far=None)
        if resample and self.fps is None:
            raise InputError("--resample: the checkpoint does not contain the frame rate of its training")
        scene = Scene.open(folder, fitting=fitting, fps=self.fps if resample or self.data.subsample_fps else None)
        self.check_scene(scene)
        if scene.recording.notes:
            warnings.warn(f"{folder}: {'; '.join(scene.recording.notes)}", FitWarning, stacklevel=2)
        if self.fps is None and scene.n_steps > 1:
            message = "frame rate not checked: the checkpoint does not contain that of its training"
            warnings.warn(message, FitWarning, stacklevel=2)
        if changes := self._changes(scene):
            warnings.warn(f"fitted to the model: {'; '.join(changes)}", FitWarning, stacklevel=2)
        return scene

    def _changes(self, scene: Scene) -> list[str]:
        """Describes what fitting changed in a scene."""
        changes, (width, height) = [], self.image_size
        sizes = sorted(set(scene.recorded_sizes) - {self.image_size})
        if sizes and self.data.resize:
            recorded = ", ".join(f"{w}x{h}" for w, h in sizes)
            areas = [w * h * max(width / w, height / h) ** 2 for w, h in sizes]
            lost = 0.0 if scene.fitting.whole else max(0.0, 1 - width * height / max(areas))
            cut = f", {lost:.0%} cropped (--keep image preserves it)" if lost >= 0.005 else ""
            changes.append(f"images of {recorded} pixels scaled to {width}x{height}{cut}")
        own = scene.own_depths
        if own is not None and (scene.near > own[0] or scene.far < own[1]):
            changes.append(
                f"depth range {own[0]:.3g} to {own[1]:.3g} replaced by that of the training, {scene.near:.3g} to "
                f"{scene.far:.3g} (--keep depth preserves it)"
            )
        if self.plan.spec.dynamics.actions and not scene.has_actions():
            changes.append("no actors, because the scene has no actions.npz")
        if scene.has_actions() and not self.plan.spec.dynamics.actions:
            changes.append("actors ignored, because the model was not trained with dynamics.actions")
        if scene.recording.subtract_background:
            changes.append(
                'background subtracted and set to black (preserve it with "masks": "none" in cameras.json, or provide '
                "masks/)"
            )
        return changes

    def check_scene(self, scene: Scene) -> None:
        """Raises InputError if the scene's image size, depth range or frame rate differs from the training's."""
        if (scene.width, scene.height) != self.image_size:
            raise InputError(
                f"{scene.path}: images of {scene.width}x{scene.height} pixels; the model was trained on "
                f"{self.image_size[0]}x{self.image_size[1]} (a model trained with data: {{resize: [W, H]}} fits them)"
            )
        fitted = scene.fitting.enlarge  # set by open_scene, which already fitted the depths
        if self.data.near_far and not fitted and (scene.near, scene.far) != tuple(self.data.near_far):
            raise InputError(
                f"{scene.path}: depth range {scene.near:g} to {scene.far:g}; the model was trained on "
                f"{self.data.near_far[0]:g} to {self.data.near_far[1]:g}: open the scene with open_scene, which fits it"
            )
        check_rate(scene, self.fps)

    def data_of(self, scene: Scene) -> DataConfig:
        """Adapts ``data`` to a scene: drops camera indices if one does not exist, and limits the number of views."""
        data = self.data
        if max((*data.context_cameras, *data.target_only_cameras), default=-1) >= scene.n_cams:
            data = dataclasses.replace(data, context_cameras=(), target_only_cameras=())
        views = min(data.context_views, scene.n_cams)
        return dataclasses.replace(data, context_views=views, fewest_views=min(data.fewest_views, views))


def model_config(config: TrainConfig) -> ModelConfig:
    """Returns the model configuration of a training: its preset with overrides."""
    if config.preset not in PRESETS:
        raise InputError(
            f"preset: must be one of {', '.join(PRESETS)}; got {shown(config.preset)}"
            f"{did_you_mean(config.preset, PRESETS)}"
        )
    dynamics = config.model.get("dynamics")
    if isinstance(dynamics, dict) and (old := [name for name in dynamics if name in SWITCHES]):
        raise InputError(
            f"model.dynamics.{old[0]}: physics is the list model.dynamics.priors now, as in configs/priors/elastic.yaml"
        )
    base = getattr(presets, config.preset)()
    return from_dict(ModelConfig, config.model, "model", base)


def keep_jacobian(simulator: Simulator, saved: dict) -> None:
    """Sets the simulator's ``renderer.jacobian`` to that of a saved model section."""
    jacobian = current_model(saved)["renderer"]["jacobian"]
    renderer = dataclasses.replace(simulator.config.renderer, jacobian=jacobian)
    simulator.config = dataclasses.replace(simulator.config, renderer=renderer)


def build_simulator(config: ModelConfig, seed: int) -> Simulator:
    """Builds a simulator, see :func:`gsim3d.pretrained.loading.build`."""
    return loading.build(simulator_class(config), config, seed)


def describe(config: TrainConfig, model: ModelConfig, scene: Scene, effects: EffectsSpec) -> dict:
    """Returns the content of a checkpoint's config.yaml."""
    rate = {"fps": float(scene.fps)} if scene.n_steps > 1 else {}
    return {
        "model": to_dict(model),
        "data": {**to_dict(config.data), "image_size": [scene.width, scene.height], **rate},
        "effects": {"spec": effects.to_dict(), "hash": effects.hash},
        "train": to_dict(config),
    }


def restore(path: str | Path, device: str = "cpu", speed: str = "exact") -> Restored:
    """Loads a simulator, also of the published model, with its training settings.

    Arguments and errors: see :meth:`gsim3d.Simulator.from_pretrained`.
    """
    simulator, saved = loading.load((Simulator, ReleasedSimulator), path, device, speed)
    data = {key: value for key, value in current_data(saved.config["data"]).items() if key not in ("image_size", "fps")}
    with naming(str(path)):
        settings = from_dict(DataConfig, upgraded(DataConfig, data), "data")
    return Restored(simulator, settings, simulator.plan(), saved)
