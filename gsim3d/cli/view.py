"""Shows a prediction or a scene in a browser: orbit, play, pause, scrub, edit.

Serves the viewer on this machine, prints its address and runs until Ctrl-C. It needs pip install 'gsim3d[viewer]'.

examples:
  gsim3d view runs/ball                                          what gsim3d simulate wrote
  gsim3d view runs/ball --scene data/elastic/ball/0000           truth and cameras beside it
  gsim3d view data/elastic/ball/0000                             a recorded scene
  gsim3d view data/elastic/ball/0000 --checkpoint elastic-small  predicted here: edit it and simulate on
  gsim3d view runs/ball --checkpoint elastic-small               go on from the last predicted steps
  gsim3d view garden.spz
"""

import argparse

from gsim3d.cli.arguments import add_fitting, number, whole
from gsim3d.pretrained import CHECKPOINT_HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("target", metavar="TARGET", help="run, its state, scene folder, file of Gaussians, or folder with one a frame")
    add("--scene", metavar="SCENE", help="recorded scene that TARGET predicts")
    add("--checkpoint", metavar="CHECKPOINT", help=f"simulator that goes on from a scene or state: {CHECKPOINT_HELP}")
    add("--start", type=whole(0), default=0, help="step of the scene that is shown first (default: 0)")
    add("--steps", type=whole(1), help="steps to predict with --checkpoint (default: to the end of the video)")
    add_fitting(parser)
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")
    add("--fps", type=number(0, 1e6, above=True), help="frames a second (default: TARGET's, else 24)")
    add("--up", choices=("y", "z"), help="axis that points up in files of Gaussians (default: as their format says)")
    add("--port", type=whole(0, 65535), default=0, help="of the address (default: a free one)")
    add("--public", action="store_true", help="let other machines connect: they can write files here")


def run(args: argparse.Namespace) -> int:
    from gsim3d.errors import InputError
    from gsim3d.train.restore import restore
    from gsim3d.viewer.server import LOCAL, PUBLIC, Viewer, load_viser
    from gsim3d.viewer.simulation import Simulation
    from gsim3d.viewer.targets import open_state, open_target, state_of

    load_viser()
    simulation = None
    if args.checkpoint is None:
        if args.steps or args.keep or args.resample:
            raise InputError("--steps, --keep and --resample need --checkpoint")
        target = open_target(args.target, scene=args.scene, start=args.start, fps=args.fps, up=args.up)
    else:
        if args.scene or args.up or args.fps:
            raise InputError("--scene, --up and --fps do not go with --checkpoint: TARGET is the scene or state itself")
        restored = restore(args.checkpoint, args.device)
        if state := state_of(args.target):
            if args.start or args.keep or args.resample:
                raise InputError(f"--start, --keep and --resample belong to scenes; {state} is a state")
            source = open_state(state, restored)
        else:
            source = restored.open_scene(args.target, args.keep, args.resample)
        simulation = Simulation(restored, source, args.steps, args.start)
        target = simulation.target
    with Viewer(target, simulation, host=PUBLIC if args.public else LOCAL, port=args.port) as viewer:
        print(f"{target.name}: {target.n_frames} frames at {viewer.address} (Ctrl-C ends)", flush=True)
        try:
            viewer.wait()
        except KeyboardInterrupt:
            print()
    return 0
