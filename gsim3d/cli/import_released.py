"""``gsim3d import``: a checkpoint of the authors' release becomes one of this package."""

from __future__ import annotations

import argparse

EPILOG = """\
CHECKPOINT is a .ckpt file of the release, CONFIG the resolved .yaml that lies beside it (configs/NAME.yaml for
models/NAME.ckpt): sizes come from the weights, what no weight shows (cell size, strides, limits, history) from it.
DIR becomes a checkpoint folder that simulate and evaluate take; its model reproduces the published one, oddities
included (DIR/config.yaml has "release: true"). Tensors that are missing or of another shape are named, and nothing is
written. The file is read without running anything in it: one that asks for other code is refused.

examples:
  gsim3d import models/elastic.ckpt --config configs/elastic.yaml -o runs/elastic
  gsim3d evaluate runs/elastic DATA
  gsim3d simulate runs/elastic DATA/bunny/0 --out runs/bunny
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Imports a checkpoint of the authors' release and tells what it found in it."
    parser.epilog = EPILOG
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="published checkpoint (.ckpt)")
    parser.add_argument("--config", metavar="CONFIG", required=True, help="its resolved configuration (.yaml)")
    parser.add_argument("-o", "--out", metavar="DIR", required=True, help="folder to write; must not exist yet")


def run(args: argparse.Namespace) -> int:
    from pathlib import Path

    from gsim3d.compat.released_import import import_released
    from gsim3d.errors import InputError
    from gsim3d.io import checkpoint
    from gsim3d.io.files import new_output_path, with_parents
    from gsim3d.io.settings import load_yaml, to_dict

    out = new_output_path(args.out)
    source, settings = Path(args.checkpoint), load_yaml(args.config)
    try:
        imported = import_released(source, settings)
    except InputError as error:
        # Messages about the file start with its name, about shapes with "weights", about settings with a key.
        message = str(error).replace("weights:", f"{source}:", 1) if str(error).startswith("weights:") else str(error)
        raise InputError(message if message.startswith(str(source)) else f"{args.config}: {message}") from None
    config, effects = imported.config, imported.config.effects
    checkpoint.write(
        with_parents(out),
        checkpoint.Checkpoint(
            model=imported.weights,
            config={
                "model": to_dict(config.model),
                "data": config.data,
                "effects": {"spec": effects.to_dict(), "hash": effects.hash},
            },
            state={
                "step": imported.counts.get("global_step", 0),
                "imported": {
                    "file": source.name,
                    "untrained_blocks": imported.signs.blocks,
                    "notes": list(config.notes),
                },
            },
        ),
    )
    print(_report(imported))
    print(f"written: {out}")
    return 0


def _report(imported) -> str:
    config = imported.config
    encoder, dynamics = config.model.encoder, config.model.dynamics
    kind = "explicit" if encoder.explicit else "latent"
    trained = "".join(f", {name.replace('_', ' ')} {count}" for name, count in imported.counts.items())
    lines = [
        f"{imported.n_parameters:,} parameters{trained}",
        f"{kind} model: {encoder.dynamic_dim} changing and {encoder.static_dim} fixed latents, history of "
        f"{config.data['history']}, {encoder.n_depths} depths, cells of {dynamics.grid_size:g} m, images of "
        f"{config.data['image_size'][0]}x{config.data['image_size'][1]}",
        f"training: {imported.signs.sentence()}",
    ]
    lines += [f"note: {note}" for note in config.notes]
    if imported.ignored:
        lines.append(f"tensors ignored, as the release does: {', '.join(imported.ignored)}")
    if config.ignored:
        lines.append(f"settings that change nothing here: {', '.join(config.ignored)}")
    return "\n".join(lines)
