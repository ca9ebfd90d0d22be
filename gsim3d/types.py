"""The data that walks through gsim3d: Cameras, Frames, Particles, Gaussians.

All of them are ragged: rows of many clouds (a cloud is one scene at one time step) are packed one after another, and
``cu_rows`` says where each cloud starts. Sizes: B scenes, Q clouds, I images, N rows, C channels, H W pixels.
Units are metres and pixels; axes are OpenCV's (x right, y down, z forward); quaternions are (w, x, y, z).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

DYNAMIC, FROZEN = 0, 1  # values of Particles.activity


class _Tensors:
    """Moves and selects all tensors of a dataclass together."""

    def map(self, f):
        """The same object with ``f`` applied to every tensor."""
        return dataclasses.replace(
            self, **{k: f(v) for k, v in vars(self).items() if isinstance(v, Tensor)}
        )

    def to(self, device):
        return self.map(lambda t: t.to(device))

    def detach(self):
        return self.map(Tensor.detach)


@dataclass(frozen=True)
class Cameras(_Tensors):
    """Calibrated pinhole cameras, one row an image.

    viewmats: [I, 4, 4] world-to-camera, OpenCV axes.
    Ks: [I, 3, 3] in pixels, full principal point, pixel centres at +0.5.
    near, far: [I] metres, depth range in which the scene lies.
    image_cloud: int64 [I], the cloud that each image shows.
    width, height: pixels, the same for all images of one call.
    """

    viewmats: Tensor
    Ks: Tensor
    near: Tensor
    far: Tensor
    image_cloud: Tensor
    width: int
    height: int

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def select(self, images: Tensor, image_cloud: Tensor | None = None) -> Cameras:
        """The cameras of rows ``images``; ``image_cloud`` replaces the cloud ids where given."""
        return Cameras(
            self.viewmats[images],
            self.Ks[images],
            self.near[images],
            self.far[images],
            self.image_cloud[images] if image_cloud is None else image_cloud,
            self.width,
            self.height,
        )


@dataclass(frozen=True)
class Frames(_Tensors):
    """Images of calibrated cameras: what the simulator sees.

    images: float32 [I, 3, H, W] in [0, 1].
    cameras: I rows; images of one cloud are its views, any number of them.
    cloud_scene, cloud_step: int64 [Q]; clouds are sorted by (scene, step), steps of a scene count from 0.
    origin: float64 [B, 3] metres, lower corner of each scene's workspace; voxels are counted from it.
    masks: bool [I, H, W], pixels that become particles; None: all.
    dynamic: bool [I, H, W], pixels of bodies that may move; None: all.
    valid: bool [I, H, W], pixels that were filmed: no padding; losses look at no others; None: all.
    """

    images: Tensor
    cameras: Cameras
    cloud_scene: Tensor
    cloud_step: Tensor
    origin: Tensor
    masks: Tensor | None = None
    dynamic: Tensor | None = None
    valid: Tensor | None = None

    def to(self, device):
        return dataclasses.replace(super().to(device), cameras=self.cameras.to(device))


@dataclass(frozen=True)
class Particles(_Tensors):
    """The state of the simulator: particles with view-independent latent features.

    means: [N, 3] metres, world.            opacities: [N] in (0, 1).
    dynamic_latents: [N, Fd], change with time.   static_latents: [N, Fs], do not.
    cu_rows: int64 [Q + 1]; rows of cloud q are cu_rows[q] .. cu_rows[q + 1].
    cloud_scene, cloud_step: int64 [Q], sorted by (scene, step).
    activity: uint8 [N], 0 dynamic, 1 frozen (never moves). A masked-out particle is absent.
    origin: float64 [B, 3] metres, lower corner of each scene's workspace.
    quats [N, 4] (w, x, y, z), scales [N, 3] metres, sh [N, K, 3]: only in explicit models.

    Rows of two encoded steps are not aligned (each step sees other pixels); rows of two simulated steps are.
    """

    means: Tensor
    opacities: Tensor
    dynamic_latents: Tensor
    static_latents: Tensor
    cu_rows: Tensor
    cloud_scene: Tensor
    cloud_step: Tensor
    activity: Tensor
    origin: Tensor
    quats: Tensor | None = None
    scales: Tensor | None = None
    sh: Tensor | None = None

    ROW_FIELDS = (
        "means", "opacities", "dynamic_latents", "static_latents", "activity", "quats", "scales", "sh",
    )

    @property
    def n_rows(self) -> int:
        return self.means.shape[0]

    @property
    def n_clouds(self) -> int:
        return self.cloud_scene.shape[0]

    def row_cloud(self) -> Tensor:
        """int64 [N], the cloud of each row."""
        counts = self.cu_rows[1:] - self.cu_rows[:-1]
        return torch.repeat_interleave(
            torch.arange(self.n_clouds, device=counts.device), counts, output_size=self.n_rows
        )

    def select_rows(self, rows: Tensor) -> Particles:
        """Keeps ``rows`` (bool [N]); clouds stay, even where they become empty."""
        kept = torch.zeros(self.n_rows + 1, dtype=torch.int64, device=rows.device)
        kept[1:] = torch.cumsum(rows, 0)
        fields = {k: getattr(self, k)[rows] for k in self.ROW_FIELDS if getattr(self, k) is not None}
        return dataclasses.replace(self, **fields, cu_rows=kept[self.cu_rows])

    def select_clouds(self, clouds: Tensor) -> Particles:
        """The particles of ``clouds`` (int64, ascending)."""
        counts = self.cu_rows[1:] - self.cu_rows[:-1]
        keep = torch.zeros(self.n_clouds, dtype=torch.bool, device=clouds.device)
        keep[clouds] = True
        rows = torch.repeat_interleave(keep, counts, output_size=self.n_rows)
        fields = {k: getattr(self, k)[rows] for k in self.ROW_FIELDS if getattr(self, k) is not None}
        cu_rows = torch.zeros(clouds.shape[0] + 1, dtype=torch.int64, device=clouds.device)
        cu_rows[1:] = torch.cumsum(counts[clouds], 0)
        return dataclasses.replace(
            self, **fields, cu_rows=cu_rows, cloud_scene=self.cloud_scene[clouds], cloud_step=self.cloud_step[clouds]
        )


@dataclass(frozen=True)
class Gaussians(_Tensors):
    """3D Gaussians, packed like the particles they came from.

    means [N, 3] metres, quats [N, 4] (w, x, y, z), scales [N, 3] metres, opacities [N] in (0, 1),
    sh [N, K, 3] coefficients of the standard 3DGS basis (K = (degree + 1)^2; colour = sum + 0.5, clamped at 0),
    cu_rows int64 [Q + 1].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    cu_rows: Tensor
