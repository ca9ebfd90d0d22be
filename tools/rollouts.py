#!/usr/bin/env python
"""Long rollouts and the gradients through them: writes docs/results/long_rollouts.md and .png.

python -m gsim3d demo --train --out runs/demo
python tools/rollouts.py --demo runs/demo

Also trains `small` on the demo's scenes for a few minutes, into runs/demo/small; stopped and started again, it goes on.
Every model starts from generated scenes; each image is thinned to a few particles: a thousand steps take a minute.
"""

import argparse
import dataclasses
import math
import os
import sys
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d import presets  # noqa: E402
from gsim3d.cli.demo import DemoConfig  # noqa: E402
from gsim3d.data import Scene, find_scenes, split_scenes  # noqa: E402
from gsim3d.evaluate.pictures import pyplot  # noqa: E402
from gsim3d.testing.check_stability import Subject, open_subject, sample_of_scenes  # noqa: E402
from gsim3d.testing.invariances import Sample  # noqa: E402
from gsim3d.testing.stress import Curves, gradient_norms, rollout_curves  # noqa: E402
from gsim3d.train.loop import Trainer  # noqa: E402
from gsim3d.train.restore import build_simulator  # noqa: E402

HORIZONS = (12, 48)  # steps that gradients are taken through
SMALL_STEPS = (60, 20)  # of training `small`: from a history of 2 to the next step, and to the third
EVERY = 32  # one of so many kept pixels becomes a particle
PAGE, PICTURE = (ROOT / "docs" / "results" / f"long_rollouts.{kind}" for kind in ("md", "png"))
TEXT = """# Long rollouts

Written by `python tools/rollouts.py --demo runs/demo` after `gsim3d demo --train --out runs/demo`; do not edit.

{n_steps} steps from two generated scenes ({particles} particles in all). "random": weights as they are drawn, with a
head that moves particles by centimetres a step; "tiny, demo": what `gsim3d demo` trained; "small, demo": `small` after
{small_steps} steps on the same scenes (a day on a GPU is what it is made for).

Bounded is not right: long after the horizon that they were trained on, these models let bodies sink through the
ground. A particle that leaves the workspace (here 1.4 m below the origin) falls asleep by rule, no longer awake;
when the last moving one has left, the energy is 0. These models hold opacities, so their mass cannot drift.
Metres, metres a step; from the first step to the last where there are two. `tests/stability/test_long_rollouts.py`
and case D42 of [stability.md](stability.md) assert that speed, energy, extent and opacity stay bounded.

![Energy and opacity over a rollout](long_rollouts.png)

| model | steps | top speed | its limit | kinetic energy | opacity mass drifts by | extent | awake | moves until |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rollouts}

## Gradients through a rollout

Norm of the gradient of the last image's mean squared value with respect to the particles (positions and dynamic
latents) before the first, the middle and the last step, and the largest of all. They are the same with checkpointing,
to the bit, and bounded on hard scenes; training clips the norm over all parameters (the same tests).

| model | steps | before step 1 | before the middle | before the last | largest | of all parameters |
| --- | --- | --- | --- | --- | --- | --- |
{gradients}
"""


def random_subject(preset: str) -> Subject:
    simulator = build_simulator(getattr(presets, preset)(), seed=0)
    torch.manual_seed(1)
    with torch.no_grad():
        simulator.dynamics.net.head.fc2.weight.normal_(std=0.1)
    return Subject(simulator.eval(), {"preset": preset})


def trained_small(demo: Path) -> Subject:
    train = DemoConfig().train
    phases = tuple(dataclasses.replace(s, steps=n) for s, n in zip(train.phases, SMALL_STEPS, strict=False))
    config = dataclasses.replace(train, preset="small", phases=phases, checkpoint_every=10)
    folders, _ = split_scenes(find_scenes(demo / "data"))
    trainer = Trainer(config, [Scene.open(folder) for folder in folders], demo / "small")
    if trainer.step < config.n_steps:
        trainer.run()
    return open_subject(demo / "small")


def thinned(sample: Sample) -> Sample:
    kept = sample.frames.masks
    if kept is None:
        kept = torch.ones_like(sample.frames.images[:, 0], dtype=torch.bool)
    number = kept.flatten(1).cumsum(1).view(kept.shape)
    return dataclasses.replace(sample, frames=dataclasses.replace(sample.frames, masks=kept & (number % EVERY == 1)))


def rollout_row(name: str, curves: Curves, limit: float) -> str:
    mass = curves.opacity_mass
    drift = max(abs(m / mass[0] - 1) for m in mass)
    energy = f"{curves.kinetic_energy[0]:.2g} to {curves.kinetic_energy[-1]:.2g}"
    awake = f"{curves.awake[0]} to {curves.awake[-1]}"
    moving = max(step for step, energy in enumerate(curves.kinetic_energy, 1) if energy > 0)
    speed, extent = f"{max(curves.speed):.3f}", f"{max(curves.extent):.2f}"
    return f"| {name} | {len(mass)} | {speed} | {limit:.3f} | {energy} | {drift:.1e} | {extent} | {awake} | {moving} |"


def gradient_row(name: str, norms: list[float], of_parameters: dict) -> str:
    total = math.sqrt(sum(float(g.double().square().sum()) for g in of_parameters.values()))
    numbers = (norms[0], norms[len(norms) // 2], norms[-1], max(norms), total)
    assert all(map(math.isfinite, numbers)), f"{name}: a gradient is not finite"
    return f"| {name} | {len(norms)} | " + " | ".join(f"{number:.2e}" for number in numbers) + " |"


def draw(curves: dict[str, Curves]) -> None:
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
    for name, curve in curves.items():
        left.plot([max(e, 1e-12) for e in curve.kinetic_energy], label=name, linewidth=0.8)
        right.plot([m / curve.opacity_mass[0] for m in curve.opacity_mass], label=name, linewidth=0.8)
    left.set(yscale="log", xlabel="step", ylabel="kinetic energy")
    right.set(xlabel="step", ylabel="opacity mass / first", ylim=(0.98, 1.02))
    left.legend(fontsize=7)
    part = PICTURE.with_name(f".{PICTURE.stem}.part.png")
    figure.savefig(part, dpi=90)
    os.replace(part, PICTURE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demo", type=Path, required=True, help="what gsim3d demo wrote")
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    subjects = {
        "tiny, random": random_subject("tiny"),
        "tiny, demo": open_subject(args.demo / "model.safetensors"),
        "small, random": random_subject("small"),
        "small, demo": trained_small(args.demo),
    }
    torch.set_num_threads(1)  # such small tensors gain nothing from more
    curves, rollouts, gradients, particles = {}, [], [], 0
    for name, subject in subjects.items():
        sample, problems = sample_of_scenes(subject, find_scenes(args.demo / "data"))
        assert not problems, problems
        sample, simulator = thinned(sample), subject.simulator
        state = simulator.encode(sample.frames).detach()
        particles = state.n_rows
        print(f"{name}: {particles} particles", flush=True)
        with torch.no_grad():
            curves[name] = rollout_curves(simulator, state, args.steps, sample.plan)
        step = simulator.config.dynamics.max_step
        limit = simulator.config.stability.max_speed if step is None else math.sqrt(3) * step
        rollouts.append(rollout_row(name, curves[name], limit))
        for horizon in HORIZONS:
            found = gradient_norms(simulator, state, sample.targets, horizon, sample.plan)
            gradients.append(gradient_row(name, *found))
        print("\n".join([rollouts[-1], *gradients[-len(HORIZONS) :]]), flush=True)
    draw(curves)
    tables = {"rollouts": "\n".join(rollouts), "gradients": "\n".join(gradients)}
    part = PAGE.with_name(f".{PAGE.name}.part")
    part.write_text(TEXT.format(n_steps=args.steps, particles=particles, small_steps=sum(SMALL_STEPS), **tables))
    os.replace(part, PAGE)


if __name__ == "__main__":
    main()
