"""Registry of metrics, and per-step scores of the predicted images of one scene."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from torch import Tensor

from gsim3d.data.recording import BACKGROUND, FIXED, MOVING
from gsim3d.errors import InputError, did_you_mean
from gsim3d.evaluate.metrics import SSIM_WINDOW, psnr, ssim
from gsim3d.evaluate.perceptual import fvd, lpips, weights


@dataclass(frozen=True)
class Metric:
    """A metric of predicted images."""

    label: str  #: name in tables
    digits: int  #: number of decimals in tables
    rises: bool = True  #: whether higher is better
    #: weights that it needs, a key of gsim3d.evaluate.perceptual.weights.SOURCES; None if it needs none
    weights: str | None = None
    by_step: bool = True  #: whether it has a value for each image


METRICS = {
    "psnr": Metric("PSNR", 2),
    "psnr_masked": Metric("PSNR masked", 2),
    "psnr_body": Metric("PSNR body", 2),
    "psnr_ground": Metric("PSNR ground", 2),
    "psnr_ring": Metric("PSNR ring", 2),
    "ssim": Metric("SSIM", 4),
    "lpips_alex": Metric("LPIPS alex", 4, rises=False, weights="lpips_alex"),
    "lpips_vgg": Metric("LPIPS vgg", 4, rises=False, weights="lpips_vgg"),
    "fvd": Metric("FVD", 1, rises=False, weights="fvd_i3d", by_step=False),
}
PLAIN_METRICS = tuple(name for name, metric in METRICS.items() if metric.weights is None)
NEEDS_LABELS = ("psnr_masked", "psnr_body", "psnr_ground", "psnr_ring")
# Baselines: images of "constant" with true pixels where the label is the given one.
EXACT_PARTS = {"perfect_ground": FIXED, "perfect_body": MOVING}
ALONE = "-object"  # ending of the name of a method whose object alone is compared, on black
RING_WIDTH = 0.3  # in diameters of the body


@dataclass(frozen=True)
class SceneScores:
    """Scores of one scene."""

    scene: str  #: name of the scene
    n_encoded: int  #: number of input steps
    n_steps: int  #: number of all steps, S
    #: method -> metric -> float64 [S], mean over the target views at each step. Steps before ``n_encoded`` are
    #: reconstructions of the model and NaN for other methods; steps with empty masks are NaN.
    values: dict[str, dict[str, Tensor]]
    #: method (and ``"truth"``) -> I3D features [V, 400] of the predicted steps in each target view, for FVD
    clips: dict[str, Tensor]
    not_measured: dict[str, str]  #: metric -> reason why it has no value
    #: float64 [S], fraction of the foreground covered by bodies, mean over the target views; None without labels
    body_share: Tensor | None = None
    digest: str = ""  #: hash of the true images and labels
    #: method -> measure of :func:`gsim3d.evaluate.physics.measure_tracks` -> float64 [S - n_encoded]
    physics: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    fitted: dict[str, dict] = field(default_factory=dict)  #: method that is fitted to the scene -> what it found


def ring_around_bodies(labels: Tensor) -> Tensor:
    """Marks the ground within ``RING_WIDTH`` diameters of the nearest body, where shadows fall.

    Bodies are connected components of MOVING pixels; the diameter is that of a disc of equal area.

    Args:
        labels: uint8 [..., H, W].

    Returns:
        bool [..., H, W], on the device of ``labels``.
    """
    images = labels.cpu().numpy().reshape(-1, *labels.shape[-2:])
    ring = np.zeros(images.shape, bool)
    for image, near in zip(images, ring):
        body = image == MOVING
        if not body.any():
            continue
        distance, nearest = cv2.distanceTransformWithLabels((~body).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        diameter = np.sqrt(4 / np.pi * np.bincount(nearest[body], minlength=nearest.max() + 1))
        near[:] = (distance <= RING_WIDTH * diameter[nearest]) & (image == FIXED)
    return torch.from_numpy(ring).view(labels.shape).to(labels.device)


def measurable(names: Sequence[str] | None = None) -> tuple[tuple[str, ...], dict[str, str]]:
    """Returns (metrics to measure, {other metric: reason}).

    Args:
        names: metrics to measure. Default: all whose weights are installed.

    Raises:
        InputError: a metric does not exist, or its weights are not installed.
    """
    missing = {n: m.weights for n, m in METRICS.items() if m.weights and not weights.installed(m.weights)}
    if names is None:
        chosen = tuple(name for name in METRICS if name not in missing)
        return chosen, {name: weights.how_to_install(needed) for name, needed in missing.items()}
    for name in names:
        if name not in METRICS:
            raise InputError(
                f"metric {name!r} does not exist; metrics: {', '.join(METRICS)}{did_you_mean(name, METRICS)}"
            )
        if name in missing:
            raise weights.WeightsMissing(f"metric {name} needs weights: {weights.how_to_install(missing[name])}")
    return tuple(name for name in METRICS if name in names), {}


class SceneTruth:
    """Ground truth of one scene, which scores predicted images.

    Args:
        name: name of the scene.
        images: [S, V, H, W, 3], colours in [0, 1].
        labels: uint8 [S, V, H, W]: 0 background, 1 static geometry, 3 movable bodies; None if the scene has none.
        valid: bool [S, V, H, W], pixels to score; the others are black in the recording. None: all.
        n_encoded: number of input steps.
        metrics: metrics to measure; those that do not apply are listed in ``not_measured``.
    """

    def __init__(
        self,
        name: str,
        images: Tensor,
        labels: Tensor | None,
        valid: Tensor | None,
        n_encoded: int,
        metrics: Sequence[str],
    ):
        self.name, self.images, self.labels, self.valid, self.n_encoded = name, images, labels, valid, n_encoded
        self.not_measured = {m: reason for m in metrics if (reason := self._problem(m))}
        self.metrics = [metric for metric in metrics if metric not in self.not_measured]
        self.masks = {"psnr": valid}
        if labels is not None:
            regions = {"masked": labels != BACKGROUND, "body": labels == MOVING, "ground": labels == FIXED}
            self.masks |= {f"psnr_{region}": mask for region, mask in regions.items()}
            if "psnr_ring" in self.metrics:
                self.masks["psnr_ring"] = ring_around_bodies(labels)

    def score(self, methods: Iterable[tuple[str, Tensor]]) -> SceneScores:
        """Scores methods one at a time, so that only one method's images are in memory.

        Args:
            methods: (name, images); images are [S, V, H, W, 3] in [0, 1], for all steps or only the predicted ones.
        """
        values, clips, parts = {}, {}, {}
        with_clips = "fvd" in self.metrics
        if with_clips:
            clips["truth"] = self._clip_features(self.images)
        for name, images in methods:
            if self.valid is not None:
                images = images * self.valid[-len(images) :, ..., None]
            values[name] = self._by_step(images, self.metrics)
            if with_clips:
                clips[name] = self._clip_features(images)
            if name == "constant" and "psnr_masked" in self.metrics:
                true, labels = self.images[-len(images) :], self.labels[-len(images) :, ..., None]
                for part, label in EXACT_PARTS.items():
                    parts[part] = self._by_step(torch.where(labels == label, true, images), ["psnr_masked"])
        values |= parts
        share = None
        if self.labels is not None:  # NaN at steps without foreground
            bodies, mask = (self.masks[f"psnr_{region}"].sum((2, 3)).double() for region in ("body", "masked"))
            share = (bodies / mask).nanmean(1).cpu()
        return SceneScores(self.name, self.n_encoded, len(self.images), values, clips, self.not_measured, share)

    def _problem(self, metric: str) -> str | None:
        """Returns the reason why ``metric`` does not apply to this scene; None if it does."""
        n_steps, _, height, width = self.images.shape[:4]
        smallest = {"ssim": SSIM_WINDOW, "lpips_alex": lpips.MIN_SIZE["alex"], "lpips_vgg": lpips.MIN_SIZE["vgg"]}
        if metric in NEEDS_LABELS and self.labels is None:
            return f"{self.name} has no segmentation"
        if min(height, width) < smallest.get(metric, 1):
            return f"{self.name} has images of {width}x{height} pixels; at least {smallest[metric]} are required"
        if metric == "fvd" and n_steps - self.n_encoded < fvd.MIN_FRAMES:
            return f"{fvd.MIN_FRAMES} predicted steps are required; {self.name} has {n_steps - self.n_encoded}"
        return None

    def _by_step(self, images: Tensor, metrics: Sequence[str]) -> dict[str, Tensor]:
        """Returns metric -> float64 [S], mean over views ignoring NaN; NaN for steps without images."""
        n_steps = len(self.images)
        scores = {m: torch.full((n_steps,), torch.nan, dtype=torch.float64) for m in metrics if METRICS[m].by_step}
        for step, pred in enumerate(images, n_steps - len(images)):
            for metric, values in scores.items():
                values[step] = self._measured(metric, pred, self.images[step], step).nanmean()
        return scores

    def _measured(self, metric: str, pred: Tensor, true: Tensor, step: int) -> Tensor:
        """Returns the values [V] of one step."""
        if metric == "ssim":
            return ssim(pred, true)
        if metric.startswith("lpips"):
            return lpips.lpips(pred, true, metric.removeprefix("lpips_"))
        mask = self.masks[metric]
        return psnr(pred, true, None if mask is None else mask[step])

    def _clip_features(self, images: Tensor) -> Tensor:
        """Returns the I3D features [V, 400] of the predicted steps."""
        n_future = len(self.images) - self.n_encoded
        return fvd.clip_features(images[-n_future:].transpose(0, 1)).cpu()
