"""``gsim3d plan``: what a scene calls for, and what a model therefore computes."""

from __future__ import annotations

import argparse

from gsim3d.pretrained import CHECKPOINT_HELP, add_fitting

EPILOG = """\
Without --effects the spec is effects.yaml of the scene or of the data set around it, else that of the checkpoint,
which is what gsim3d simulate computes without --effects. Without a checkpoint the model is the preset tiny.
Multiply-adds are predicted from the sizes of layers and the scene's masks, for matrix products, attention and splats:
what they tell is how two plans compare (docs/effects.md). Where gsim3d profile has timed the checkpoint, milliseconds
are predicted from them.

examples:
  gsim3d plan runs/data/ball/0000
  gsim3d plan runs/data/ball/0000 runs/model
  gsim3d plan runs/data/ball/0000 elastic-small --effects effects.yaml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Shows which effects are computed, which are not and why, and what that costs."
    parser.epilog = EPILOG
    parser.add_argument("scene", metavar="SCENE", help="scene folder of any layout (docs/data.md)")
    parser.add_argument("checkpoint", metavar="CHECKPOINT", nargs="?", help=CHECKPOINT_HELP)
    add_fitting(parser)
    parser.add_argument("--effects", metavar="FILE", help="YAML file of what to compute (default: see below)")


def run(args: argparse.Namespace) -> int:
    from gsim3d import presets
    from gsim3d.data import Scene
    from gsim3d.effects.plan import background_cost, in_columns, predicted_cost
    from gsim3d.effects.spec import EffectsSpec, OutputEffects
    from gsim3d.train.config import DataConfig
    from gsim3d.train.restore import build_simulator, restore

    restored = None if args.checkpoint is None else restore(args.checkpoint)
    scene = Scene.open(args.scene) if restored is None else restored.open_scene(args.scene, args.keep, args.resample)
    simulator = build_simulator(presets.tiny(), seed=0) if restored is None else restored.simulator
    data = DataConfig() if restored is None else restored.data_of(scene)
    spec, source = EffectsSpec.of_scene(args.scene), "the scene's own"
    if args.effects is not None:
        spec, source = EffectsSpec.load(args.effects), args.effects
    elif spec is None:
        spec, source = EffectsSpec(), "none, so the model's own"
        if restored is not None:
            spec, source = restored.plan.spec, "the checkpoint's"
    plan = simulator.plan(spec)
    work = workload(scene, data)
    count = f"{work.moving} moving and {work.frozen} frozen particles a step"
    print(f"{scene.name}: {count}, 1 image of {scene.width}x{scene.height}")
    print(f"model: {args.checkpoint or 'preset tiny, untrained'}; effects: {source}, {spec.hash}\n")
    rows = [("effect", "computed", "why", "takes")]
    rows += [(e.name, "yes" if e.kept else "no", e.why, e.takes) for e in plan.effects]
    print(in_columns(rows))
    sizes = {name: p.numel() * p.element_size() for name, p in simulator.named_parameters()}
    unused = sum(sizes[name] for name in plan.unused)
    share = f"{len(plan.unused)} of {len(sizes)}, {unused / 1024:.1f} of {sum(sizes.values()) / 1024:.1f} KiB"
    print(f"\nparameters not needed: {share}")
    for name in plan.unused:
        print(f"  {name}")
    most = simulator.plan(EffectsSpec(outputs=OutputEffects(depth=True, alpha=True)))
    ours, all_on = (predicted_cost(p, simulator.config, work) for p in (plan, most))
    print("\npredicted multiply-adds of one step and one image, in millions")
    print(in_columns(_beside(ours, all_on, unit=1e6)))
    if once := background_cost(plan, simulator.config, work):
        print(f"and of the background, once a rollout: {once / 1e6:.1f}")
    for device, times in ({} if restored is None else _times(args.checkpoint, restored)).items():
        ours, all_on = (times.predicted(restored.plan, p, simulator.config, work) for p in (plan, most))
        print(f"\npredicted milliseconds on {device}, from those that gsim3d profile measured ({times.on})")
        print(in_columns(_beside(ours, all_on)))
    return 0


def _times(checkpoint: str, restored) -> dict:
    """Device -> what a step of the checkpoint took there; empty where nobody measured it."""
    from gsim3d.pretrained import located
    from gsim3d.profile.autotune import load_times

    place = located(checkpoint)
    return load_times(place if place.is_dir() else place.parent, restored)


def _beside(ours: dict[str, float], all_on: dict[str, float], unit: float = 1.0) -> list[tuple[str, ...]]:
    """Rows of a table: parts of a step under a plan, and under one with all that the model can."""
    parts = [*((part, ours[part], all_on[part]) for part in all_on), ("all", sum(ours.values()), sum(all_on.values()))]
    rows = ((p, f"{one / unit:.1f}", f"{most / unit:.1f}", f"{one / max(most, 1e-6):.2f}") for p, one, most in parts)
    return [("part", "this plan", "all that the model can", "share"), *rows]


def workload(scene, data):
    """Particles of the first step as the model would see it, and one image."""
    from gsim3d.data import make_frames
    from gsim3d.effects.plan import Workload
    from gsim3d.train.samples import context_cameras, spread_views, thinned

    cameras = context_cameras(scene, data)
    views = spread_views(cameras, min(data.context_views, len(cameras)), 0)
    frames = make_frames([scene], [list(views)], [range(1)], masked=scene.has_segmentation())
    frames = thinned(frames, data)
    pixels = frames.images.shape[0] * scene.height * scene.width
    kept = pixels if frames.masks is None else int(frames.masks.sum())
    moving = kept
    if frames.dynamic is not None:
        moving = int((frames.dynamic if frames.masks is None else frames.dynamic & frames.masks).sum())
    return Workload(moving, kept - moving, 1, scene.height * scene.width)
