"""Shows which effects are computed, and their predicted costs.

Without --effects, the specification is effects.yaml of the scene or its data set, or else that of the checkpoint, as
for gsim3d simulate. Without a checkpoint, the model is the preset tiny. Multiply-adds of matrix products, attention and
splats are predicted from layer sizes and the scene's masks; they compare two plans of one model
(docs/reference/effects.md). If gsim3d profile has timed the checkpoint, milliseconds are predicted, too.

examples:
  gsim3d plan runs/data/ball/0000
  gsim3d plan runs/data/ball/0000 runs/model
  gsim3d plan runs/data/ball/0000 elastic-small --effects effects.yaml
"""

import argparse

from gsim3d.cli.arguments import add_fitting
from gsim3d.pretrained import CHECKPOINT_HELP, folder_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="scene folder of any layout (docs/reference/data.md)")
    parser.add_argument("checkpoint", metavar="CHECKPOINT", nargs="?", help=CHECKPOINT_HELP)
    add_fitting(parser)
    parser.add_argument("--effects", metavar="FILE", help="YAML file of the effects (default: see below)")


def run(args: argparse.Namespace) -> int:
    from gsim3d import presets
    from gsim3d.data import Scene
    from gsim3d.effects.spec import EffectsSpec
    from gsim3d.evaluate.plan_report import load_times, plan_report, workload
    from gsim3d.train.config import DataConfig
    from gsim3d.train.restore import build_simulator, restore

    if args.checkpoint is None:
        scene, data, times = Scene.open(args.scene), DataConfig(), {}
        simulator = build_simulator(presets.tiny(), seed=0)
        own, source = simulator.plan(), "none, so the model's own"
    else:
        restored = restore(args.checkpoint)
        scene = restored.open_scene(args.scene, args.keep, args.resample)
        times = load_times(folder_of(args.checkpoint), restored)
        data, simulator = restored.data_of(scene), restored.simulator
        own, source = restored.plan, "the checkpoint's"
    spec = EffectsSpec.of_scene(args.scene)
    if args.effects is not None:
        spec, source = EffectsSpec.load(args.effects), args.effects
    elif spec is not None:
        source = "the scene's own"
    plan, work = own if spec is None else simulator.plan(spec), workload(scene, data)
    size = f"1 image of {scene.width}x{scene.height}"
    print(f"{scene.name}: {work.moving} moving and {work.frozen} frozen particles per step, {size}")
    model = f"{args.checkpoint or 'preset tiny, untrained'}, {simulator.config.dynamics.network}"
    print(f"model: {model}; effects: {source}, {plan.spec.hash}")
    for paragraph in plan_report(simulator, plan, work, times, own):
        print(f"\n{paragraph}")
    return 0
