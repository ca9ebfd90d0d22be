"""Loading and saving of simulators: parses a saved configuration and validates weights against it."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_parameter_registration_hook,
)
from torch.overrides import TorchFunctionMode

from gsim3d import pretrained
from gsim3d.cameras import InputSpec
from gsim3d.compat.checkpoints import current_data, current_model, current_weights
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.files import shown
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.numerics.speed import load_speed
from gsim3d.numerics.trust import load_trust
from gsim3d.ops import cuda_compiled
from gsim3d.presets import ModelConfig

Model = TypeVar("Model", bound=nn.Module)


@dataclass(frozen=True)
class Description:
    """Parsed configuration of a checkpoint."""

    model: ModelConfig  #: model configuration
    effects: EffectsSpec  #: effects that the model was trained to simulate
    inputs: InputSpec | None  #: input specification of the training; None if unknown

    def to_dict(self) -> dict[str, Any]:
        """Returns the content of a checkpoint's config.yaml."""
        data = {} if self.inputs is None else {k: v for k, v in to_dict(self.inputs).items() if v is not None}
        effects = {"spec": self.effects.to_dict(), "hash": self.effects.hash}
        return {"model": to_dict(self.model), "data": data, "effects": effects}


def load(
    kinds: Sequence[type[Model]], name_or_path: str | Path, device: str, speed: str
) -> tuple[Model, checkpoint.Checkpoint]:
    """Loads a simulator of one of the classes ``kinds``, and its checkpoint.

    Other arguments and errors: see :meth:`gsim3d.Simulator.from_pretrained`.
    """
    check_device(device)
    saved = checkpoint.load(name_or_path)
    released = current_model(saved.config["model"]).get("release") is True
    cls = next((kind for kind in kinds if released == (kind.config_class is not ModelConfig)), None)
    if cls is None:
        wanted = "gsim3d.compat.load_released" if released else "Simulator.from_pretrained"
        raise InputError(f"{name_or_path}: checkpoint of another kind of model; load it with {wanted}")
    try:
        setting = load_speed(pretrained.folder_of(name_or_path), saved.digest, torch.device(device).type, speed)
        found = describe(saved.config, cls.config_class, pretrained.frame_rate(name_or_path))
        simulator = with_weights(cls, setting.of_model(found.model), found.effects, saved.weights)
    except InputError as error:
        raise InputError(f"{name_or_path}: {error}") from None
    except Exception as error:  # an invalid configuration can raise any exception
        raise InputError(f"{name_or_path}: its configuration is not a valid model: {_line_of(error)}") from None
    asymmetric = simulator.config.dynamics.is_asymmetric
    simulator.effects, simulator.setting = setting.of_effects(found.effects, asymmetric), setting
    simulator.inputs = setting.of_inputs(found.inputs)
    if speed == "exact":  # other speeds change the measures of the input
        simulator.trust = load_trust(pretrained.folder_of(name_or_path), saved.digest)
    return simulator.eval().to(device), saved


def save(simulator: nn.Module, folder: Path) -> Path:
    """Saves ``simulator`` to ``folder``, see :meth:`gsim3d.Simulator.save_pretrained`."""
    if folder.exists() and not (folder / checkpoint.STATE).is_file():
        raise InputError(f"{folder}: exists and is not a checkpoint; use a new folder")
    config = Description(simulator.config, simulator.effects, simulator.inputs).to_dict()
    folder.parent.mkdir(parents=True, exist_ok=True)
    return checkpoint.write(folder, checkpoint.Checkpoint(simulator.state_dict(), config, {"step": 0}))


def describe(config: dict[str, Any], kind: type[ModelConfig] = ModelConfig, fps: float | None = None) -> Description:
    """Parses the content of a checkpoint's config.yaml; ``fps`` is the default of frames per second. Raises InputError,
    which names the key, if it is invalid."""
    model = from_dict(kind, current_model(config["model"]), "model")
    effects = EffectsSpec.from_dict(config.get("effects", {}).get("spec"))
    names = {field.name for field in dataclasses.fields(InputSpec)}
    data = {key: value for key, value in current_data(config["data"]).items() if key in names and value is not None}
    given = data.pop("fps", None)
    fps = fps if given is None else given
    if fps is not None and (isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 1e-3 <= fps <= 1e6):
        raise InputError(f"data.fps must be frames per second, a number from 0.001 to 1e6; got {shown(fps)}")
    size = data.get("image_size")
    if not isinstance(size, (list, tuple)) or len(size) != 2 or not all(isinstance(side, int) for side in size):
        raise InputError(f"data.image_size must be [width, height]; got {shown(size)}")
    return Description(model, effects, dataclasses.replace(from_dict(InputSpec, data, "data"), fps=fps))


def build(make: Callable[[ModelConfig], Model], config: ModelConfig, seed: int = 0) -> Model:
    """Builds a simulator with weights initialised from ``seed``; raises InputError if sizes are not valid.

    torch's random state is preserved.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            return make(config)
        except InputError:
            raise
        except Exception as error:  # invalid layer sizes can raise any exception
            raise InputError(f"model: sizes are not valid: {_line_of(error)}") from None


def _line_of(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def with_weights(
    make: Callable[[ModelConfig], Model], config: ModelConfig, effects: EffectsSpec, weights: dict[str, Tensor]
) -> Model:
    """Builds a simulator with ``weights``. Those that ``effects`` do not use may be missing: they keep their initial
    values and are listed in ``simulator.absent``. Raises InputError if the weights do not fit the model."""
    try:
        weights = current_weights(weights, config.dynamics)
        check_sizes(make, config, effects, weights)
        simulator = build(make, config)
        own = first_weights(simulator, effects, weights)
        simulator.load_state_dict({**own, **weights})
    except RuntimeError as error:
        raise InputError(f"the weights do not fit the model: {str(error).splitlines()[-1].strip()}") from None
    simulator.absent, simulator.effects = frozenset(own), effects
    return simulator


class _WithoutFirstWeights(TorchFunctionMode):
    """Mode that skips values of meta tensors, for which torch would import its compiler."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        first = args[0] if args else (kwargs or {}).get("tensor")
        skipped = function.__name__.endswith(("normal_", "uniform_", "div", "mul", "normalize"))
        return first if skipped and getattr(first, "is_meta", False) else function(*args, **(kwargs or {}))


def first_weights(simulator: nn.Module, effects: EffectsSpec, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Returns the initial values of weights that ``effects`` do not use and that are missing in ``weights``."""
    lacks = set(simulator.plan(effects).unused).difference(weights)
    return {name: value for name, value in simulator.state_dict().items() if name in lacks}


def check_sizes(
    make: Callable[[ModelConfig], nn.Module], config: ModelConfig, effects: EffectsSpec, weights: dict[str, Tensor]
) -> None:
    """Raises RuntimeError if ``weights`` do not fit ``config``, without allocating the model."""
    n_most, n_made = sum(value.numel() for value in weights.values()), 0

    def count(_module, _name, value):
        nonlocal n_made
        n_made += 1 if value is None else max(1, value.numel())
        if n_made > 2 * n_most:  # constructors may register a parameter more than once
            raise RuntimeError(f"it has more than twice their {n_most} values")

    n_blocks = sum(config.dynamics.encoder_depths) + sum(config.dynamics.decoder_depths)
    if n_blocks > len(weights):
        raise RuntimeError(f"it has {n_blocks} blocks in its dynamics; the weights are {len(weights)} tensors")
    hooks = [register_module_parameter_registration_hook(count), register_module_buffer_registration_hook(count)]
    try:
        with torch.device("meta"), _WithoutFirstWeights():
            simulator = make(config)
    finally:
        for hook in hooks:
            hook.remove()
    sizes = {name: torch.empty_like(value, device="meta") for name, value in weights.items()}
    simulator.load_state_dict({**first_weights(simulator, effects, weights), **sizes})


def check_device(device: str) -> None:
    """Raises InputError if ``device`` ("cpu" or "cuda") is not available."""
    try:
        kind = torch.device(device).type
    except (RuntimeError, TypeError):
        kind = None
    if kind not in ("cpu", "cuda"):
        raise InputError(f"device: must be cpu or cuda; got {shown(device)}")
    if kind == "cuda" and not (cuda_compiled() and torch.cuda.is_available()):
        reason = "torch finds no GPU" if cuda_compiled() else "gsim3d was built without CUDA"
        raise InputError(f"device {device}: {reason} (see gsim3d doctor)")
