#!/usr/bin/env python
"""Compares predictions of the shipped models in this tree and in another one: all attributes, bit by bit.

Both trees encode the same scenes, simulate 12 steps and take gradients of a rollout of 2 steps, each in a process.

    python tools/compare_trees.py OLD_TREE SCENES

SCENES holds one data set of each world, made by ``gsim3d generate elastic --out SCENES/elastic`` and so on.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

MODELS, N_STEPS, N_STEPS_BACK, BOUND = ("elastic", "rigid", "cloth"), 12, 2, 1e-5
OLD_NAMES = ("un" + "lit", "shaded", "turns", "held", "paint", "reference", "light")  # of attributes, before these:
NEW_NAMES = (
    *("initial_latents", "light_occlusion", "orientations", "frozen_appearance", "color_transform", "rest_positions"),
    "irradiance_gain",
)
NAMES = dict(zip(OLD_NAMES, NEW_NAMES, strict=True))


def predict(model: str, scenes: Path, out: Path) -> None:
    """Writes the attributes of every step and the gradients of all weights of the dynamics."""
    from gsim3d.evaluate.protocol import default_views, encode_steps
    from gsim3d.train.restore import restore

    torch.set_num_threads(1)
    restored = restore(f"{model}-small")
    simulator = restored.simulator.eval()
    scene = restored.open_scene(sorted(path.parent for path in (scenes / model).rglob("metadata.json"))[0])
    with torch.no_grad():
        state = encode_steps(restored, scene, default_views(restored, scene)[0], 0)
        steps = simulator.rollout(state, N_STEPS, restored.plan)
    found = {
        f"{i}.{NAMES.get(name, name)}": value
        for i, step in enumerate([state, *steps])
        for name in type(step).ROW_FIELDS
        if (value := getattr(step, name)) is not None
    }
    steps = simulator.requires_grad_().rollout(state, N_STEPS_BACK, restored.plan)
    draws, loss = torch.Generator().manual_seed(0), 0.0
    for step in steps:
        gain = next(getattr(step, name) for name in ("irradiance_gain", "light") if hasattr(step, name))
        for value in (step.means, gain, 0.01 * step.dynamic_latents):
            loss = loss + (value * torch.randn(value.shape, generator=draws)).sum()
    loss.backward()
    gradients = {name: p.grad for name, p in simulator.named_parameters() if p.grad is not None}
    try:
        from gsim3d.compat.checkpoints import current_weights

        gradients = current_weights(gradients, simulator.config.dynamics)
    except ImportError:
        pass
    torch.save({"attributes": found, "gradients": gradients}, out)


def run(tree: Path, model: str, scenes: Path, out: Path) -> dict:
    code = f"import sys; sys.path.insert(0, {str(tree)!r}); sys.path.insert(0, {str(Path(__file__).parent)!r}); "
    code += f"from pathlib import Path; import compare_trees; compare_trees.predict({model!r}, Path({str(scenes)!r}), "
    subprocess.run([sys.executable, "-c", code + f"Path({str(out)!r}))"], check=True, cwd=tree, env=os.environ)
    return torch.load(out)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--models", nargs="*", default=MODELS)
    args, here, bad = parser.parse_args(), Path(__file__).resolve().parent.parent, 0
    for model in args.models:
        with tempfile.TemporaryDirectory() as folder:
            old, new = (
                run(tree.resolve(), model, args.scenes.resolve(), Path(folder, name))
                for name, tree in (("old", args.old), ("new", here))
            )
        different = [n for n in old["attributes"] if not same_bits(old["attributes"][n], new["attributes"].get(n))]
        print(
            f"{model}: {len(old['attributes'])} attributes of {N_STEPS} steps, differing bits in {different or 'none'}"
        )
        from gsim3d.compat.checkpoints import current_weights
        from gsim3d.train.restore import restore

        before = current_weights(old["gradients"], restore(f"{model}-small").simulator.config.dynamics)
        worst = {name: relative(before[name], new["gradients"].get(name)) for name in before}
        name = max(worst, key=worst.get)
        print(f"{model}: {len(worst)} gradients of {N_STEPS_BACK} steps, worst {worst[name]:.1e} of {name}")
        bad += bool(different) + (worst[name] > BOUND)
    return bad


def same_bits(a: torch.Tensor, b: torch.Tensor | None) -> bool:
    return b is not None and a.dtype == b.dtype and torch.equal(a.nan_to_num(), b.nan_to_num())


def relative(a: torch.Tensor, b: torch.Tensor | None) -> float:
    return float("inf") if b is None else float((a - b).abs().max() / a.abs().max().clamp(min=1e-30))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    sys.exit(main())
