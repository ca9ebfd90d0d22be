"""``gsim3d evaluate``: measure predictions on a data set."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import add_fitting, whole
from gsim3d.pretrained import CHECKPOINT_HELP

EPILOG = """\
Every scene's first steps are given, all others predicted and compared with the video, seen from cameras that were no
input. Measured are psnr (all pixels), psnr_masked (without background), psnr_body (what may move), psnr_ground (the
rest), psnr_ring (ground near bodies, where shadows fall), ssim, lpips_alex, lpips_vgg and fvd, for

  model              this checkpoint
  constant           its last encoded particles, held still: what the learned dynamics adds
  copy               the true last given frame of the same camera: no model at all
  constant_velocity  its last encoded particles; what may move goes on as its centroid went last
  release_constant   its first predicted step, held still: the baseline of the published evaluation
  perfect_ground     constant, with the ground as it is in the video: what an exact ground alone would score (masked)
  perfect_body       constant, with the bodies as they are in the video (masked)

LPIPS and FVD need weights: run `gsim3d weights lpips` and `gsim3d weights fvd` once. Until then the report says that
they were not measured. FVD takes a second or two a clip on a CPU; --metrics leaves it out.

The validation and test sets are made by `gsim3d generate` with seeds 77 (24 trajectories) and 78 (56); of them all
scenes are scored. --against compares with another report on the same scenes: mean differences and their paired
standard errors; nothing below two of them is called better.

Other models, also those that know images only, are scored under the same conditions: put what they predict into
DIR/<scene folder as below DATA>/cam_<j>/<name>_<step>.png, or one video DIR/<scene folder>/cam_<j>.mp4, of the size of
the scene's images, and name DIR with --predictions. Without CHECKPOINT, --given says how many steps they were given.

Written: FILE.json (all numbers), and beside it .csv (scene, method, step), .md (tables like the paper's) and .png
(curves over time; needs matplotlib). docs/reference/evaluation.md defines every number.

examples:
  gsim3d evaluate runs/model runs/data
  gsim3d evaluate model.safetensors runs/data --scenes all --steps 16 --out metrics.json
  gsim3d evaluate elastic-small data/elastic-unseen --scenes all
  gsim3d evaluate runs/model runs/data --metrics psnr psnr_masked ssim lpips_vgg
  gsim3d evaluate runs/model runs/data --predictions video=runs/video_model
  gsim3d evaluate --predictions runs/video_model runs/data --given 4
  gsim3d evaluate runs/a/metrics.json --against runs/b/metrics.json
  torchrun --nproc-per-node 4 -m gsim3d evaluate runs/model runs/data --device cuda
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Measures how well a simulator predicts the scenes of a data set."
    parser.epilog = EPILOG
    add, checkpoint = parser.add_argument, f"{CHECKPOINT_HELP} (left out: only --predictions are scored)"
    cameras = {"type": whole(0), "nargs": "+", "metavar": "CAM"}
    add("checkpoint", metavar="CHECKPOINT", nargs="?", help=checkpoint)
    add("data", metavar="DATA", help="folder with scenes, or one scene folder; a report, to compare it with --against")
    add(
        "--predictions",
        metavar="[NAME=]DIR",
        action="append",
        default=[],
        help="predictions of another model to score; may be given several times",
    )
    add("--given", type=whole(1), metavar="N", help="steps that the other models were given (no CHECKPOINT)")
    add(
        "--scenes",
        choices=("test", "train", "all"),
        help="which part of the data set (default: test, the scenes that `gsim3d train` holds out; of the validation "
        "and test sets all)",
    )
    add(
        "--split",
        choices=("gsim3d", "published"),
        default="gsim3d",
        help="rule that holds scenes out (default: gsim3d; published: that of the released model, which leaks in small "
        "sets)",
    )
    add("--steps", type=whole(1), help="steps to predict (default: to the end of the shortest video)")
    compared = "cameras to compare (default: those kept from the training's inputs; without CHECKPOINT all predicted)"
    add("--cameras", help=compared, **cameras)
    add("--context", help="input cameras (default: spread evenly)", **cameras)
    add("--metrics", nargs="+", metavar="METRIC", help="what to measure (default: all whose weights are installed)")
    add("--clips", type=whole(2), default=48, metavar="N", help="most clips of which FVD is measured (default: 48)")
    add_fitting(parser)
    add("--against", metavar="FILE", help="compare with this report (metrics.json) of another model on the same scenes")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")
    add(
        "--out",
        metavar="FILE",
        help="JSON file (default: metrics.json beside the checkpoint's files, in the folder of the predictions, or, of "
        "a simulator that comes with gsim3d, in the current folder)",
    )


def run(args: argparse.Namespace) -> int:
    from gsim3d.evaluate.job import Job, evaluate

    evaluate(Job(**vars(args)))
    return 0
