"""Import of published checkpoints (``gsim3d import``), with validation of every tensor."""

import re
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.compat.released import DYNAMICS, ENCODER, LATENTS, from_published, to_published
from gsim3d.compat.released_config import ReleasedConfig, Shapes, read_config
from gsim3d.compat.released_file import ReleasedFile, state_dict
from gsim3d.compat.released_model import ReleasedSimulator
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.files import new_output_path, read_yaml, with_parents
from gsim3d.io.settings import to_dict
from gsim3d.presets import ModelConfig

MAX_NAMED = 8  # tensors listed in a message


@dataclass(frozen=True)
class UntrainedSigns:
    """Result of :func:`untrained_signs`."""

    blocks: int  #: number of attention and MLP blocks of the dynamics whose weights look untrained
    n_blocks: int  #: number of all blocks
    latent_heads: bool | None  #: whether latent heads and their conditioning look untrained; None without heads

    def sentence(self) -> str:
        if self.blocks == 0 and not self.latent_heads:
            return "attention, MLP and latent heads have been trained"
        heads = {True: "so do the latent heads", False: "the latent heads were trained", None: "it has no latent heads"}
        return (
            f"{self.blocks} of {self.n_blocks} attention and MLP blocks look untrained; {heads[self.latent_heads]} "
            "(the published training could lose these gradients: see docs/compat/migration.md)"
        )


@dataclass(frozen=True)
class Imported:
    """A converted published checkpoint."""

    config: ReleasedConfig  #: converted configuration
    weights: dict[str, Tensor]  #: state dict of :class:`gsim3d.Simulator`
    n_parameters: int  #: number of published parameters
    ignored: tuple[str, ...]  #: names of tensors that the model does not have
    counts: dict[str, int]  #: epoch and global_step, if stored
    signs: UntrainedSigns  #: untrained parts


def import_released(path: str | Path, settings: dict) -> Imported:
    """Reads and converts a published checkpoint with the settings of its resolved YAML file. Raises InputError if the
    file is of another kind or could run code, a setting is not supported, or tensors are missing or misshapen."""
    with ReleasedFile(path) as file:
        stored, counts = state_dict(file)
        shapes = {name: tensor.shape for name, tensor in stored.items()}
        config = read_config(settings, shapes)
        expected = published_shapes(config.model)
        check_shapes(shapes, expected, file.path)
        published = {name: file.read(stored[name]) for name in expected if name in stored}
    weights = from_published(published, config.model)
    trained = [name for name in published if not re.search(r"running_|num_batches", name)]
    n_parameters = sum(published[name].numel() for name in trained)
    ignored = tuple(name for name in stored if name not in expected)
    return Imported(config, weights, n_parameters, ignored, counts, untrained_signs(published))


def published_shapes(config: ModelConfig) -> Shapes:
    """Returns the expected names and shapes of a published checkpoint, computed on the meta device."""
    with torch.device("meta"):
        weights = ReleasedSimulator(config).state_dict()
    return {name: tuple(value.shape) for name, value in to_published(weights, config).items()}


def check_shapes(found: Shapes, expected: Shapes, where: Path) -> None:
    """Raises InputError if tensors are missing or have the wrong shape; the message names them."""
    missing = [name for name in expected if name not in found and not name.endswith("num_batches_tracked")]
    different = {name: shape for name, shape in expected.items() if found.get(name, shape) != shape}
    wrong = [f"{name} is {list(found[name])} instead of {list(shape)}" for name, shape in different.items()]
    unexpected = [name for name in found if name not in expected]
    if missing or wrong:
        groups = {"missing": missing, "of another shape": wrong, "unexpected": unexpected}
        parts = [f"{len(group)} {what}: {_few(group)}" for what, group in groups.items() if group]
        raise InputError(f"{where}: its tensors do not fit the configuration; {'; '.join(parts)}")


def _few(names: list[str]) -> str:
    return ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else "")


def untrained_signs(published: dict[str, Tensor]) -> UntrainedSigns:
    """Detects weights that are still as initialised.

    The published training could lose the gradients of attention, MLPs and latent heads. Untrained parts have norms with
    constant weight and zero bias, and linear weights of at most 1 / sqrt(inputs), scaled down by weight decay.
    """
    blocks = {match[1] for name in published if (match := re.match(rf"{re.escape(DYNAMICS)}(.*\.block\d+)\.", name))}
    untrained = [block for block in blocks if _drawn_block(published, f"{DYNAMICS}{block}.")]
    layers = [*LATENTS, "depth_predictor.global_cond.0.", "depth_predictor.global_cond.2."]
    heads = [f"{ENCODER}{layer}" for layer in layers if f"{ENCODER}{layer}weight" in published]
    drawn = all(_drawn_layer(published, head) for head in heads) if heads else None
    return UntrainedSigns(len(untrained), len(blocks), drawn)


def _drawn_block(published: dict[str, Tensor], prefix: str) -> bool:
    norms = [f"{prefix}norm{i}.0." for i in (1, 2)]
    weights = torch.cat([published[f"{norm}weight"] for norm in norms])
    constant = bool((weights == weights[0]).all()) and 0.5 < weights[0].item() <= 1
    zero = all(not published[f"{norm}bias"].any() for norm in norms)
    layers = [f"{prefix}{name}." for name in ("attn.qkv", "attn.proj", "mlp.0.fc1", "mlp.0.fc2")]
    return constant and zero and all(_drawn_layer(published, layer) for layer in layers)


def _drawn_layer(published: dict[str, Tensor], prefix: str) -> bool:
    weight, bias = published[f"{prefix}weight"], published[f"{prefix}bias"]
    bound = weight[0].numel() ** -0.5 * (1 + 1e-6)
    return weight.abs().max().item() <= bound and bias.abs().max().item() <= bound


def write_imported(source: str | Path, settings_file: str | Path, out: str | Path) -> str:
    """Imports a checkpoint of the authors' release (.ckpt) with its resolved configuration (.yaml) into the new
    checkpoint folder ``out``; returns a report. Raises InputError if a file is not of the release, or both differ."""
    out, source, settings = new_output_path(out), Path(source), read_yaml(settings_file)
    try:
        imported = import_released(source, settings)
    except InputError as error:
        # Messages start with the file's name, with "weights:" (shapes), or with a key (settings).
        message = str(error).replace("weights:", f"{source}:", 1) if str(error).startswith("weights:") else str(error)
        raise InputError(message if message.startswith(str(source)) else f"{settings_file}: {message}") from None
    config, effects = imported.config, imported.config.effects
    origin = {"file": source.name, "untrained_blocks": imported.signs.blocks, "notes": list(config.notes)}
    of_effects = {"spec": effects.to_dict(), "hash": effects.hash}
    saved = {"model": to_dict(config.model), "data": config.data, "effects": of_effects}
    state = {"step": imported.counts.get("global_step", 0), "imported": origin}
    checkpoint.write(with_parents(out), checkpoint.Checkpoint(model=imported.weights, config=saved, state=state))
    return f"{_report(imported)}\nwritten: {out}"


def _report(imported: Imported) -> str:
    config = imported.config
    encoder, dynamics = config.model.encoder, config.model.dynamics
    kind = "explicit" if encoder.explicit else "latent"
    trained = "".join(f", {name.replace('_', ' ')} {count}" for name, count in imported.counts.items())
    lines = [
        f"{imported.n_parameters:,} parameters{trained}",
        f"{kind} model: {encoder.dynamic_dim} dynamic and {encoder.static_dim} static latents, history of "
        f"{config.data['history']}, {encoder.n_depths} depths, grid size {dynamics.grid_size:g} m, images of "
        f"{config.data['image_size'][0]}x{config.data['image_size'][1]}",
        f"training: {imported.signs.sentence()}",
    ]
    lines += [f"note: {note}" for note in config.notes]
    if imported.ignored:
        lines.append(f"ignored tensors (also ignored by the release): {', '.join(imported.ignored)}")
    if config.ignored:
        lines.append(f"ignored settings (no effect in gsim3d): {', '.join(config.ignored)}")
    return "\n".join(lines)
