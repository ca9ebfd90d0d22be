"""Reads recorded scenes, lists all problems, and optionally draws a contact sheet of frames and cameras.

Reads every file of every scene: descriptions, cameras, all images and masks. Each problem is printed in one line with
file, camera and frame. Exit code: 0 no problems, 1 problems found, 2 the check could not run.

Supported layouts (all keys: docs/reference/data.md):
  genesis      metadata.json with n_steps, n_cams, file_path_template and cam_<j>: as `gsim3d generate` writes
  kubric       cam_<j>/metadata.json with rgba_<t>.png and segmentation_<t>.png: Kubric and MOVi
  transforms   transforms.json of nerfstudio, with a time for every frame
  hocap        meta.yaml or meta.json, with folders of cameras: HO-Cap
  videos       cameras.json, and for each camera one video <name>.mp4 or one folder <name>/<number>.png or .jpg

Check the contact sheet: in every frame the orange box must enclose the moving bodies, the world axes (x red, y green, z
blue) must point in consistent directions, and the other cameras (magenta) must be where they are seen. The blue box is
the bounds of the scene, given or the region that most cameras see; the yellow line is the outline of the masks,
green dots are points of actors.
  neither axes nor orange box       flipped y and z axes (OpenGL instead of OpenCV), or camera-to-world matrices
  box next to the bodies            intrinsics of another image size, or a principal point not adjusted for cropping
  wrong in one camera only          that camera's pose is wrong, or two cameras are swapped

examples:
  gsim3d check-data runs/data --out check-data.png
  gsim3d check-data my_recording --out my_recording.png
"""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("data", metavar="DIR", help="folder with scenes of any layout, or one scene folder")
    parser.add_argument("--out", metavar="FILE.png", help="contact sheet to write (default: none)")
    parser.add_argument("--quiet", action="store_true", help="print only problems and the summary")


def run(args: argparse.Namespace) -> int:
    import os
    from concurrent.futures import ThreadPoolExecutor
    from functools import partial

    from gsim3d.data import find_scenes
    from gsim3d.data.check import check_scene, contact_sheet, describe
    from gsim3d.io.files import output_path, with_parents, write_picture
    from gsim3d.io.terminal import progress

    out = None if args.out is None else output_path(args.out, ".png")
    folders = find_scenes(args.data)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        hidden = args.quiet or len(folders) == 1
        checks = pool.map(partial(check_scene, quiet=args.quiet or len(folders) > 1), folders)
        checks = list(progress(checks, "scenes", len(folders), unit="scene", quiet=hidden))
    for check in checks:
        if check.problems or not args.quiet:
            print(describe(check.scene) if check.scene else f"{check.path}: cannot be opened")
        for problem in check.problems:
            print(f"  problem: {problem}")
    scenes = [check.scene for check in checks if check.scene]
    if scenes and out is not None:
        write_picture(with_parents(out), contact_sheet(scenes)[..., ::-1])
    n_problems = sum(len(check.problems) for check in checks)
    n_bad = sum(bool(check.problems) for check in checks)
    read = f"{len(checks)} scene{'s' if len(checks) > 1 else ''} read"
    found = f"{n_problems} problem{'s' if n_problems > 1 else ''} in {n_bad}" if n_problems else "no problem"
    sheet = "use --out to draw a contact sheet" if out is None else f"contact sheet: {out}"
    print(f"{read}, {found}; {sheet if scenes else 'no scene could be opened'}")
    return 1 if n_problems else 0
