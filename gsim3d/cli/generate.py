"""Simulates bodies and records them with calibrated cameras on two rings.

worlds:
  elastic   soft bodies fall on a round ground
  rigid     rigid bodies are thrown on a round ground
  cloth     soft bodies fall on a cloth with four fixed corners
  push      a round pusher moves one to three bodies over the ground; 27 points of it are recorded (actions.npz)
  cloth-grip  one or two grippers move a cloth or lay it down; their positions are recorded
  hands     two hands of 21 keypoints take, carry and put down a body; their keypoints are recorded

examples:
  gsim3d generate elastic --out data/mini                      34 short scenes at 128 pixels
  gsim3d generate cloth --preset published --out data/cloth    1200 trajectories of 84 frames at 128 pixels
  gsim3d generate rigid --preset diverse --set higher --trajectories 100 --out data/rigid-higher
  gsim3d generate elastic --out data/cow --mesh cow.obj --objects none --seed 7
  gsim3d generate elastic --out data/seven --mesh genesis:dragon

presets (--preset):
  published six bodies with fixed looks, size and material; a plain ground; 1200 trajectories of the paper's length
  mini      the same with 24 frames and 34 trajectories (default)
  diverse   random pattern, colours, size, material and spin for every trajectory; a ground of three colours

sets (--set), with the preset's cameras:
  train     training data
  unseen    shapes that are in no training set: cross, dumbbell, knot, pyramid
  several   two or three bodies (diverse rigid: four or five; cloth: two)
  no-ground bodies are thrown up and fall freely, recorded for 0.7 s (elastic, rigid)
  raised    the ground is 15 to 30 cm higher (elastic, rigid)
  higher    larger drop heights

layout:
  DIR/<object>/<sample>/metadata.json                  cameras (world-to-camera, pixels), fps, near, far, origin
  DIR/<object>/<sample>/cam_<j>/rgb_<step>.png         colour
                               /seg_<step>.png         0 background, 1 ground, 3 bodies and cloth
                               /inst_<step>.png        0 background, 1 ground, 2 and more: each body, the cloth last
                               /depth_<step>.png       16 bits, 0.1 mm along the optical axis, 0: background (--depth)
  DIR/<object>/<sample>/states.npz                     nodes of each body and of the cloth at every step, metres
  DIR/<object>/<sample>/actions.npz                    positions of the points of actors at every step, metres
  DIR/manifest.json                                    options, hashes, rejected draws, machine, versions
  DIR/effects.yaml                                     effects of the scenes (gsim3d plan)

The same options give the same bytes for any number of processes. An interrupted command continues when it is run
again. A larger --trajectories adds scenes to a finished set. For many machines, run --part I/N on each, and then once
without it: tools/slurm/generate.sbatch.
"""

import argparse

from gsim3d.cli.arguments import number, whole

LENGTH = number(0, above=True)  # metres


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, lengths = parser.add_argument, {"type": LENGTH, "nargs": 2, "metavar": ("LOW", "HIGH")}
    add("world", metavar="WORLD", help="elastic, rigid, cloth, push, cloth-grip or hands")
    add("--out", metavar="DIR", required=True, help="folder of the data set; created or continued")
    add("--preset", default="mini", help="options to start from: mini (default), published or diverse")
    add("--set", dest="subset", metavar="NAME", help="train (default), or a held-out set, see below")
    add("--size", dest="image_size", type=whole(16, 4096), metavar="PX", help="width and height of the images")
    add("--frames", dest="n_frames", type=whole(1), metavar="N", help="steps of a trajectory")
    add("--fps", type=number(0, above=True), help="steps a second")
    help = "number of scenes, assigned to objects in turn"
    add("--trajectories", dest="n_trajectories", type=whole(1), metavar="N", help=help)
    add("--seed", type=whole(0), help="random seed (default 0)")
    objects = "ball, blob, box, capsule, cone, cylinder, ellipsoid, spot, star, torus"
    add("--objects", type=_names, metavar="A,B", help=f"{objects} (default: those of the preset), or none")
    add(
        "--mesh",
        dest="meshes",
        action="append",
        metavar="FILE",
        help="an additional object: a mesh file with its texture, or genesis:NAME (duck, dragon, worm, bunny ...) of "
        "an installed genesis-world; repeatable",
    )
    add("--mesh-up", choices=("y", "z"), help="axis of mesh files that points up (default y)")
    add("--drop", dest="drop_height", help="range of drop heights, metres", **lengths)
    add("--body-size", help="range of body diameters, metres", **lengths)
    add("--background", choices=("black", "white"), help="colour behind the ground (default black)")
    add(
        "--camera-spread",
        type=number(0, 0.25),
        metavar="S",
        help="varies the cameras between scenes: distance by a factor of 1 +- S, heights and angles in proportion "
        "(default 0: equal cameras)",
    )
    add("--depth", action="store_true", default=None, help="also write depth images")
    add("--engine", help="mujoco (default), or genesis: the paper's MPM and PBD (pip install 'gsim3d[genesis]')")
    add("--processes", type=whole(1), metavar="N", help="number of processes (default: number of cores)")
    part = "generate the I-th of N parts of the scenes; a call without it then completes the set"
    add("--part", type=_part, metavar="I/N", help=part)
    add("--quiet", action="store_true", help="no progress bar")


def _names(text: str) -> tuple[str, ...]:
    return () if text == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def _part(text: str) -> tuple[int, int]:
    try:
        part, count = map(int, text.split("/"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be I/N, such as 3/16; got {text!r}") from None
    return part, count


def run(args: argparse.Namespace) -> int:
    from gsim3d.synth.run import generate

    options = {k: tuple(v) if isinstance(v, list) else v for k, v in vars(args).items() if v is not None}
    report = generate(options.pop("out"), options.pop("world"), progress=not options.pop("quiet"), **options)
    count, n_made = len(report.folders), report.n_made
    print(f"{count} scene{'s' * (count > 1)} in {args.out}: {n_made} generated, {count - n_made} kept")
    for reason, count in sorted(report.rejected.items()):
        print(f"  {count} draw{'s' * (count > 1)} rejected: {reason}")
    return 0
