"""The constants that keep numbers bounded, in the order in which the documentation shows them."""

from dataclasses import dataclass

_RASTER = "csrc/gsim3d/raster/raster_math.h"
_STATE = "gsim3d/dynamics/step.py"
_CONFIG = "gsim3d/dynamics/config.py"
_STABILITY = "gsim3d/numerics/policy.py"


@dataclass(frozen=True)
class Constant:
    """name and value: as the line of ``file`` that defines it has them. consequence: of the constant, for a user."""

    name: str
    value: str
    unit: str
    file: str
    consequence: str


CONSTANTS = (
    Constant(
        "kMinAlpha",
        "1.0 / 255",
        "1",
        _RASTER,
        "a Gaussian is left out of pixels where its alpha is smaller: less than a step of an 8-bit image",
    ),
    Constant(
        "kMaxAlpha",
        "0.99",
        "1",
        _RASTER,
        "1 / (1 - alpha) in the backward pass is at most 100; 0.01 of what is behind an opaque Gaussian shines through",
    ),
    Constant(
        "kMinTransmittance",
        "1e-4",
        "1",
        _RASTER,
        "a pixel ends before less of its light is left; what is behind has no gradient",
    ),
    Constant(
        "kDilation",
        "0.3",
        "pixels^2",
        _RASTER,
        "added to both variances: the determinant is at least 0.09, a Gaussian at least half a pixel wide",
    ),
    Constant(
        "kFieldMargin",
        "0.15",
        "of the image's size",
        _RASTER,
        "a clamped Jacobian is taken at most so far outside of the image",
    ),
    Constant(
        "kLargest",
        "1e15",
        "of any number",
        _RASTER,
        "a Gaussian with a larger number is left out, or an error by policy: products and squares stay finite",
    ),
    Constant("kMinQuat", "1e-6", "1", _RASTER, "a shorter quaternion is the identity, without a gradient"),
    Constant(
        "NEAR_PLANE",
        "0.01",
        "metres",
        "gsim3d/nn/gaussian_head.py",
        "what is nearer to a camera is not drawn; nothing is divided by a smaller depth",
    ),
    Constant(
        "kMaxDepth",
        "16",
        "bits an axis",
        "csrc/gsim3d/curve/curve_math.h",
        "2^16 cells an axis: at 6 cm 4 km; cells outside are refused by the op",
    ),
    Constant(
        "kWorkspaceCells",
        "65536",
        "cells an axis",
        "csrc/gsim3d/validate_state/validate_state.h",
        "a particle outside sleeps",
    ),
    Constant(
        "kMinDepth",
        "T(1e-3)",
        "metres",
        "csrc/gsim3d/plane_sweep/plane_sweep_math.h",
        "smaller depths in another view count as it: places stay finite, far outside of the image",
    ),
    Constant(
        "kBias",
        "127",
        "bits",
        "csrc/gsim3d/patch_attn/patch_attn_math.h",
        "logits are counted from the largest; a weight below 2^-127 of its weight is 0",
    ),
    Constant(
        "HALF_MAX",
        "torch.finfo(torch.float16).max",
        "1",
        "gsim3d/compat/released_model.py",
        "65504: larger numbers become it where the release's half precision is imitated",
    ),
    Constant(
        "MASKED",
        "-100.0",
        "1",
        "gsim3d/nn/multiview_encoder/transformer.py",
        "added to masked scores: weights of 4e-44, and a row of masked keys is finite",
    ),
    Constant("EPS", "1e-3", "variance", "gsim3d/nn/layers.py", "batch normalisation divides by at least 0.03"),
    Constant("eps", "1e-5", "variance", "gsim3d/ops/row_norm.py", "layer normalisation divides by at least 0.003"),
    Constant(
        "kMinEps", "1e-30", "variance", "csrc/gsim3d/row_norm/row_norm_torch.cpp", "no smaller eps can be asked for"
    ),
    Constant(
        "LARGEST",
        "{torch.float32: 1e15, torch.float64: 1e150, torch.float16: 65504.0, torch.bfloat16: 1e15}",
        "of any number",
        "gsim3d/ops/_arguments.py",
        "larger numbers are refused by ops on the CPU; `check=False` leaves the look at them out",
    ),
    Constant(
        "MIN_ROWS",
        "16",
        "rows",
        "gsim3d/nn/layers.py",
        "products of fewer rows are padded: a row's bits on the CPU do not depend on how many there are",
    ),
    Constant(
        "MIN_QUAT_NORM",
        "1e-6",
        "1",
        "gsim3d/math/rotations.py",
        "a shorter quaternion is the identity, without a gradient",
    ),
    Constant(
        "SMALL_ANGLE_SQUARED",
        "1e-8",
        "radians^2",
        "gsim3d/math/rotations.py",
        "a smaller rotation is its series, exact to float32",
    ),
    Constant("SCALE_STEP_SHARE", "1 / 6", "of the range of scales", _STATE, "the most that a step changes a scale"),
    Constant(
        "scale_min",
        "0.0002",
        "metres",
        _CONFIG,
        "least scale of explicit Gaussians; of the model, this is the default",
    ),
    Constant("scale_max", "0.1", "metres", _CONFIG, "largest scale, of explicit models too"),
    Constant(
        "max_step",
        "0.5",
        "metres a step and axis",
        _CONFIG,
        "a prediction moves a particle by less, through a tanh; of the model, this is the default",
    ),
    Constant("max_latent_step", "None", "1", _CONFIG, "the same for latents; 1 in the presets whose latents change"),
    Constant("max_speed", "10.0", "metres a step", _STABILITY, "who moves further falls asleep, or is held at it"),
    Constant(
        "max_latent",
        "1e4",
        "1",
        _STABILITY,
        "larger latents and colours cannot be used: it is within half precision, and its squared norms within float32",
    ),
    Constant(
        "LARGEST",
        "torch.finfo(torch.float32).max",
        "of the number",
        _STABILITY,
        "an infinite place, rotation or scale cannot be used; clamped ones become it",
    ),
    Constant("NEAREST", "1e-6", "metres", _STABILITY, "a camera whose near bound is smaller is refused"),
    Constant("FARTHEST", "1e9", "metres", _STABILITY, "cameras, origins and far bounds further away are refused"),
    Constant("PIXEL_SLACK", "1e-3", "1", _STABILITY, "a colour further outside of [0, 1] cannot be used"),
    Constant(
        "OPACITY_MARGIN",
        "1e-6",
        "1",
        "gsim3d/io/ply.py",
        "opacities are written as at least that far from 0 and 1: finite logits",
    ),
    Constant(
        "SMALLEST_SCALE",
        "1e-9",
        "metres",
        "gsim3d/io/arrays.py",
        "smaller scales are written as it: finite logarithms",
    ),
    Constant(
        "PSNR_CAP",
        "100.0",
        "dB",
        "gsim3d/evaluate/metrics.py",
        "PSNR of images whose squared error is below 1e-10, perfect ones included",
    ),
    Constant(
        "MIN_SQUARE",
        "1e-10",
        "squared feature",
        "gsim3d/evaluate/perceptual/lpips.py",
        "added where LPIPS divides by a length: finite gradients where no feature fires",
    ),
    Constant("LEAST_WEIGHT", "1e-12", "pixels", "gsim3d/train/losses.py", "a loss over no pixel is 0"),
    Constant(
        "clip_norm", "0.5", "norm of the gradient", "gsim3d/train/config.py", "a longer gradient is shortened to it"
    ),
    Constant(
        "max_skipped",
        "20",
        "steps",
        "gsim3d/train/config.py",
        "so many steps in a row that are not finite end a run, with advice",
    ),
)
