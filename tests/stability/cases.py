"""The hard cases by number: what is expected of each, and what others do with it. the documentation shows them."""

from dataclasses import dataclass

GROUPS = {
    "R": "Rasterizer",
    "S": "Serialisation and sparse convolution",
    "A": "Attention and precision",
    "T": "Time",
    "E": "Encoder and data",
    "D": "Dynamics, rollout and training",
}


@dataclass(frozen=True)
class Case:
    """words: the case.   expected: of gsim3d.   others: the published release and other packages; "" if not known."""

    words: str
    expected: str
    others: str = ""


CASES = {
    "R01": Case(
        "zero Gaussians",
        "the background; gradients exist and are 0",
        "gsplat divided by zero on the host until 2026 (`0e8709f6`, `ea0c0195`); fvdb fixed the same (`16bdac13`, "
        "`b2df12e2`); shape error in the backward pass of the original (gaussian-splatting#482)",
    ),
    "R02": Case(
        "one Gaussian, few Gaussians on a big image",
        "the formula",
        "tile edges read out of bounds (XingtongGe/gsplat PR#6)",
    ),
    "R03": Case(
        "one opaque Gaussian",
        "0.99 of its colour: alpha is capped, and 0.01 of what is behind shines through",
        "gsplat lost the colour (#571, #556) until it tied its constants to one another",
    ),
    "R04": Case(
        "opacity 0, or below 1/255",
        "left out, no gradient",
        "FastGS#58: illegal memory access from the logarithm of a number below 1",
    ),
    "R05": Case(
        "thousands of coincident opaque Gaussians",
        "pixels end early; the backward pass divides by no transmittance below 0.01",
        "gsplat: clamps added (`708fc63b`)",
    ),
    "R06": Case(
        "scales of 0, needles, pancakes",
        "0.3 square pixels of dilation keep the determinant positive; finite gradients",
        "UnityGS PR#14: a degenerate covariance covers the whole screen; gsplat: uninitialised radii (`ff784e51`)",
    ),
    "R07": Case(
        "scales that cover the screen, and beyond the number range",
        "rendered in bounded memory; beyond the range an error that names row and camera, or left out, by policy",
        "32-bit overflow in gaussian-splatting#28, ROCm/gsplat PR#10, LiteGS#21; 2.2e9 intersections, 50 GiB, in "
        "LichtFeld PR#2185; fvdb counts in 64 bits since PR#708",
    ),
    "R08": Case(
        "centre at the camera, or on its plane",
        "left out by the near plane; no direction is divided by 0",
        "diff-gaussian-rasterization PR#88 documents three divisions by 0; closed",
    ),
    "R09": Case(
        "behind the camera, or straddling the near plane",
        "left out by the centre's depth; a centre just beyond the plane is drawn",
        "a near plane of 0.2 m hides close objects; gsplat moved its own to 0.01 m (`cc966c7b`)",
    ),
    "R10": Case("camera inside an object", "finite; equal bits in every run", "artefacts in UnityGS#147"),
    "R11": Case(
        "quaternion of 0, very short or long, or no number",
        "0 is the identity without a gradient; any other length is normalised; NaN is an error that names the row, or "
        "left out, by policy",
        "release: gradients of 1e8 at zero; SpacetimeGaussians#96: half of all quaternions were zero; splat-transform "
        "PR#288; fast math made it the identity in gsplat's UT kernel, which now skips it",
    ),
    "R12": Case("equal depths", "drawn in the order of rows"),
    "R13": Case(
        "images of one pixel, one row, one column, sizes that are no multiple of 16",
        "as the formula; equal to a crop of a padded image, also for Gaussians centred outside of both",
        '3DGS and gsplat clamp the Jacobian there (gsplat#305, PR#977); `jacobian="clamped"` does',
    ),
    "R14": Case(
        "principal point off centre, two focal lengths, skew",
        "exact",
        "the release and MVSplat render with opening angles only, which loses all three",
    ),
    "R15": Case(
        "near plane of 0, far at near",
        "refused: the rasterizer names its near plane, the encoder the camera",
        "release: 1 / near becomes infinite",
    ),
    "S16": Case(
        "coordinates beyond 16 bits",
        "the op refuses and names the row (on a GPU its code is 0); in the model the particle sleeps, the others have "
        "the bits they have without it",
        "release: an assertion ends the run at 131 m; PTv3#78, #84, #41 are the same",
    ),
    "S17": Case(
        "coordinates that are no numbers",
        'an error that names scene, step, row and tensor; with `on_invalid="drop"` the particle sleeps and is counted; '
        'with `"clamp"` it goes on',
        "release: goes on silently; PTv3#32: a grid of 9.2e18 cells",
    ),
    "S18": Case(
        "negative coordinates",
        "counted from the scene's own origin: a scene that is moved by whole cells has equal bits",
        "release: shifted by the minimum over the whole batch, so scenes change each other",
    ),
    "S19": Case(
        "more than 32 clouds at 16 levels",
        "2^15 clouds above 48 bits of space, each as if alone; more are refused",
        "release: the sign overflows from 33 clouds on; Pointcept's layout has no such gap",
    ),
    "S20": Case(
        "one point; all points in one voxel",
        "valid, in training with batch normalisation too",
        "release: error of BatchNorm1d in training; pooling is silently left out where it is deeper than the curve",
    ),
    "S21": Case(
        "empty clouds, everything masked",
        "ops of zero rows, the background, a loss of 0, finite gradients",
        "release: maximum of an empty tensor raises; spconv#406: assertion",
    ),
    "S22": Case(
        "several points in a voxel",
        "a tap reads the mean of a voxel's rows; their order does not matter",
        "",
    ),
    "S23": Case(
        "cells at all corners of 2^16 cells an axis, in several clouds",
        "found in 64 bits",
        "spconv#607: overflows silently beyond 2^31",
    ),
    "S24": Case("inputs that are not contiguous", "equal bits", "PTv3#41: error from a view"),
    "A25": Case(
        "attention logits beyond half precision (65504)",
        "exact: scaled, with a float32 softmax; where the release's half precision is imitated, it saturates",
        "release: queries, keys and values are cast to half precision; Pointcept prefers bfloat16 (PR#594)",
    ),
    "A26": Case(
        "patches of no rows, short last patches, borrowed rows",
        "the dense softmax; a row counts once",
        "PTv3#150: NaN where patch sizes differ",
    ),
    "A27": Case(
        "sums over 100,000 rows",
        "added in float32 whatever the precision of the numbers",
        "spconv#442 asks for wider sums",
    ),
    "A28": Case(
        "TF32 and autocast around geometry",
        "inverses, projections, depth and places are float32 or wider; particles stay in the pixel they came from",
        'release: precision "high" for everything',
    ),
    "A29": Case(
        "batch normalisation in evaluation, a batch of one; rows of equal values",
        "batch mates do not matter: running statistics, or layer normalisation",
        "release: batch normalisation with momentum 0.01",
    ),
    "T30": Case(
        "3, 5, 6 or 7 steps of history",
        "as with the missing steps empty",
        "release: asserts a power of two",
    ),
    "T31": Case(
        "one step of history",
        "merges nothing: the model that knows no time",
        "release: works, with parameters that are never used",
    ),
    "T32": Case(
        "a step without points, the newest included",
        "as if it were absent; an empty newest step stays empty",
        'release: "Time should be power of 2" where the last step is empty; in the middle it works',
    ),
    "T33": Case(
        "clouds or steps out of order",
        "refused",
        "release: its check compares one element and lets an unsorted cloud pass",
    ),
    "E34": Case(
        "duplicated cameras, no baseline",
        "every depth is as likely; finite gradients",
    ),
    "E35": Case("parallel rays, views without overlap", "finite; no overlap costs nothing"),
    "E36": Case(
        "cameras that look away, points behind another view",
        "such views see nothing",
        "depthsplat#19: crash in grid_sampler",
    ),
    "E37": Case(
        "opacities and probabilities of exactly 0 and 1, depths driven beyond their bounds",
        "finite gradients: no power of a probability is taken; depths between near and far",
        "release: infinite gradient at 0 for any exponent but 1, its default",
    ),
    "E38": Case("constant and saturated images", "finite"),
    "E39": Case(
        "no pixel of 0; 16 bits; alpha; grey",
        "values keep their meaning; 16 bits are rounded to 8",
        "release: shifts colours and labels where an image holds no 0",
    ),
    "E40": Case(
        "cameras in another convention",
        "refused on reading: flipped axes, camera-to-world, mirrored, scaled, divided by the image size; the message "
        "says which",
        "a frequent question: mvsplat#28, #1, #23, kubric#331",
    ),
    "E41": Case(
        "calibration in float64, 10 km from zero",
        "inverted in float64, cast afterwards: latents do not notice",
        "mvsplat#23: ghosting",
    ),
    "D42": Case(
        "1,000 steps with random weights",
        "speed, extent and opacity stay bounded",
        "the paper shows 80 to 120 steps",
    ),
    "D43": Case(
        "free fall out of the workspace",
        "falls asleep and is counted; other scenes do not notice",
        "release: an assertion on the extent ends the run",
    ),
    "D44": Case(
        "gradients through 12 steps; a loss that is no number",
        "finite; clipped, with the norm logged; a step that is not finite is skipped and the weights stay",
        "release: clips at 0.5, looks at finiteness in anomaly mode only; PhysDreamer cuts gradients to one frame; "
        "warp#471, #650",
    ),
    "D45": Case(
        "opacity and scales that grow or shrink on",
        "clamped to [0, 1], and to the range of scales",
        "release: clamped at 0 only",
    ),
    "D46": Case(
        "1,000 turns",
        "unit quaternions, near the exact product",
        "release: projected anew every step",
    ),
    "D47": Case(
        "two scenes, one diverges or holds NaN",
        "the other one has the bits that it has alone; by policy an error, dropped or clamped",
        "release: scenes of a batch share their grid's origin and depth",
    ),
    "D48": Case("an object duplicated on top of itself", "finite; a particle and its copy have the same future"),
    "D49": Case(
        "metrics of perfect and of empty images",
        "100 dB; left out of the mean; a loss over no pixel is 0",
        "release: infinity and NaN",
    ),
    "D50": Case(
        "killed in any step, or while its checkpoint is written", "the curve and the weights of a run that was not"
    ),
    "E51": Case("images or cameras that are no numbers", "an error that names the image, its scene and step"),
    "E52": Case("a .ply of opacities 0 and 1, scales of 0, rotations without a direction", "finite, read as written"),
    "D51": Case("rotations without a direction", "the identity, without a gradient"),
}
