"""From configurations and checkpoints to simulators."""

from __future__ import annotations

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
from gsim3d.data.fitting import frame_stride
from gsim3d.effects.plan import Plan
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import FitWarning, InputError, did_you_mean
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.io.files import shown
from gsim3d.io.settings import from_dict, to_dict, upgraded
from gsim3d.presets import ModelConfig
from gsim3d.pretrained import KEEP, loading
from gsim3d.simulator import Simulator
from gsim3d.train.config import DataConfig, TrainConfig

SIMILAR = 1.25  # near and far are replaced by those of the training where they differ by at most this factor
PRESETS = ("tiny", "small", "paper_latent", "paper_explicit")


@dataclass(frozen=True)
class Restored:
    """A trained simulator and what it was trained for.

    Attributes:
        simulator: ready to predict.
        data: which frames and views it saw.
        plan: what it computes: the effects it was trained with.
        checkpoint: where it came from.
    """

    simulator: Simulator
    data: DataConfig
    plan: Plan
    checkpoint: Checkpoint

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) pixels of the training."""
        return tuple(self.simulator.inputs.image_size)

    @property
    def fps(self) -> float | None:
        """Frames per second of the scenes it was trained on; None: the checkpoint does not say."""
        return self.simulator.inputs.fps

    @property
    def n_encoded(self) -> int:
        """Input steps: those of the training, or fewer where the simulator's setting says so."""
        return self.simulator.inputs.history

    @property
    def device(self) -> torch.device:
        """Where the simulator's weights are, and where it predicts."""
        return next(self.simulator.parameters()).device

    def open_scene(self, folder: str | Path, keep: Sequence[str] = (), resample: bool = False) -> Scene:
        """The scene in ``folder`` as the model expects it; a :class:`gsim3d.errors.FitWarning` says what is changed.

        Args:
            keep: parts of KEEP that stay as they are: "image", scaled into the model's size instead of cropped to it,
                and "depth", near and far. Without it, near and far are those of the training where the scene's own
                differ from them by at most a factor of SIMILAR: elsewhere the model sees less with them.
            resample: take every k-th frame of a scene with k times the model's frame rate.
        Raises:
            InputError: as :meth:`check_scene` and the reader, or ``keep`` names another part.
        """
        if unknown := [part for part in keep if part not in KEEP]:
            raise InputError(f"keep must name parts of {', '.join(KEEP)}; got {unknown[0]!r}")
        exact = isinstance(self.simulator.config, ReleasedModelConfig)
        fitting = dataclasses.replace(
            self.data.fitting, slack=math.inf if exact else SIMILAR, enlarge=True, whole="image" in keep
        )
        if "depth" in keep:
            fitting = dataclasses.replace(fitting, near_far=None)
        if resample and self.fps is None:
            raise InputError("--resample: the checkpoint does not say at which frame rate it was trained")
        scene = Scene.open(folder, fitting=fitting, fps=self.fps if resample else None)
        self.check_scene(scene)
        if scene.recording.notes:
            warnings.warn(f"{folder}: {'; '.join(scene.recording.notes)}", FitWarning, stacklevel=2)
        if self.fps is None and scene.n_steps > 1:
            said = "frame rate not checked: the checkpoint does not say at which one it was trained"
            warnings.warn(said, FitWarning, stacklevel=2)
        if changes := self._changes(scene):
            warnings.warn(f"fitted to the model: {'; '.join(changes)}", FitWarning, stacklevel=2)
        return scene

    def _changes(self, scene: Scene) -> list[str]:
        """What fitting changed of a scene, in words."""
        changes, (width, height) = [], self.image_size
        sizes = sorted(set(scene.recorded_sizes) - {self.image_size})
        if sizes and self.data.resize:
            recorded = ", ".join(f"{w}x{h}" for w, h in sizes)
            areas = [w * h * max(width / w, height / h) ** 2 for w, h in sizes]
            lost = 0.0 if scene.fitting.whole else max(0.0, 1 - width * height / max(areas))
            cut = f", of which {lost:.0%} is cut off (--keep image keeps it)" if lost >= 0.005 else ""
            changes.append(f"images of {recorded} pixels scaled to {width}x{height}{cut}")
        own = scene.own_depths
        if own is not None and (scene.near > own[0] or scene.far < own[1]):
            changes.append(
                f"depths {own[0]:.3g} to {own[1]:.3g} replaced by {scene.near:.3g} to {scene.far:.3g}, those of the "
                "training (--keep depth keeps them)"
            )
        if scene.recording.subtract_background:
            changes.append(
                'background subtracted and painted black ("masks": "none" in cameras.json keeps it, masks/ replaces it)'
            )
        return changes

    def check_scene(self, scene: Scene) -> None:
        """Raises InputError where the scene's images, depths or frame rate are others than those of the training."""
        if (scene.width, scene.height) != self.image_size:
            raise InputError(
                f"{scene.path}: images of {scene.width}x{scene.height} pixels; the model was trained on "
                f"{self.image_size[0]}x{self.image_size[1]} (trained with data: {{resize: [W, H]}}, it would fit them)"
            )
        fitted = scene.fitting.enlarge  # by open_scene, which chose the depths
        if self.data.near_far and not fitted and (scene.near, scene.far) != tuple(self.data.near_far):
            raise InputError(
                f"{scene.path}: depths from {scene.near:g} to {scene.far:g}; the model was trained on "
                f"{self.data.near_far[0]:g} to {self.data.near_far[1]:g}: open the scene with open_scene, which fits it"
            )
        self._check_rate(scene)

    def _check_rate(self, scene: Scene) -> None:
        if self.fps is None or scene.n_steps == 1:
            return
        stride = frame_stride(scene.fps, self.fps)
        if stride != 1:
            how = f"--resample, or open_scene(folder, resample=True), takes one frame in {stride}"
            remedy = how if stride else "no whole multiple: resample the scene"
            raise InputError(
                f"{scene.path}: {scene.fps:g} frames per second; the model was trained at {self.fps:g} ({remedy})"
            )

    def data_of(self, scene: Scene) -> DataConfig:
        """``data`` for a scene's cameras: numbers of cameras hold where the scene has them all, and there are at most
        as many inputs as cameras."""
        data = self.data
        if max((*data.context_cameras, *data.target_only_cameras), default=-1) >= scene.n_cams:
            data = dataclasses.replace(data, context_cameras=(), target_only_cameras=())
        views = min(data.context_views, scene.n_cams)
        return dataclasses.replace(data, context_views=views, fewest_views=min(data.fewest_views, views))


def model_config(config: TrainConfig) -> ModelConfig:
    """The preset with the configuration's changes."""
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
    """``simulator`` draws as the run whose model section was ``saved``."""
    jacobian = current_model(saved)["renderer"]["jacobian"]
    renderer = dataclasses.replace(simulator.config.renderer, jacobian=jacobian)
    simulator.config = dataclasses.replace(simulator.config, renderer=renderer)


def build_simulator(config: ModelConfig, seed: int) -> Simulator:
    """A simulator whose first weights are a function of the seed; torch's own random state stays as it was.

    Raises InputError where ``config`` describes none.
    """
    return loading.build(simulator_class(config), config, seed)


def describe(config: TrainConfig, model: ModelConfig, scene: Scene, effects: EffectsSpec) -> dict:
    """The content of a checkpoint's config.yaml."""
    rate = {"fps": float(scene.fps)} if scene.n_steps > 1 else {}
    return {
        "model": to_dict(model),
        "data": {**to_dict(config.data), "image_size": [scene.width, scene.height], **rate},
        "effects": {"spec": effects.to_dict(), "hash": effects.hash},
        "train": to_dict(config),
    }


def restore(path: str | Path, device: str = "cpu", speed: str = "exact") -> Restored:
    """:meth:`gsim3d.Simulator.from_pretrained`, also of the published model, with what it was trained for.

    Raises:
        InputError: as there, or the training's data settings are not of this version.
    """
    simulator, saved = loading.load((Simulator, ReleasedSimulator), path, device, speed)
    data = {key: value for key, value in current_data(saved.config["data"]).items() if key not in ("image_size", "fps")}
    try:
        settings = from_dict(DataConfig, upgraded(DataConfig, data), "data")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return Restored(simulator, settings, simulator.plan(), saved)
