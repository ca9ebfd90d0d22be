"""What the live viewer shows: a target, the frame of a timeline, layers and colours. Independent of the browser."""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsim3d.data import Scene
from gsim3d.errors import FitWarning, InputError, check_one_of
from gsim3d.io.arrays import colors_of, dc_of, rows_of, splats_of
from gsim3d.io.files import new_output_path, with_parents
from gsim3d.io.orbit import picture
from gsim3d.io.video import write_video
from gsim3d.math.rotations import rotation_matrices, rotation_to_quat
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, Gaussians, Particles
from gsim3d.viewer import player
from gsim3d.viewer.clips import clip_frames, turbo
from gsim3d.viewer.export import write_frames

COLORINGS = ("appearance", "velocity", "activity", "latents", "trust")
AWAKE_COLOR, FROZEN_COLOR, ASLEEP_COLOR = (0.95, 0.5, 0.1), (0.55, 0.55, 0.55), (0.2, 0.45, 0.95)
FASTEST = 0.99  # quantile of the speeds that has the last colour
LATENT_RANGE = 0.02  # quantile of the latents that is black; as many are at full brightness
KEPT_FRAMES = 128
Frames = Sequence[Gaussians]
HELD = (3e-4, 200.0)  # standard deviations whose squares are neither 0 nor infinite in half precision
SPEEDS = (0.1, 4.0)  # of the timeline, relative to real time
SIZES = (0.05, 1.0)  # of the drawn Gaussians, relative to their own


class Timeline:
    """Which frame is shown, and how time passes.

    Attributes:
        n_frames: how many there are.
        fps: frames a second of real time.
        speed: relative to real time.
        playing: whether time passes.
        loop: whether the first frame follows the last.
    """

    def __init__(self, n_frames: int, fps: float):
        if n_frames < 1:
            raise InputError(f"a timeline must have at least one frame; got {n_frames}")
        if not 0 < fps < float("inf"):
            raise InputError(f"fps must be a positive number; got {fps}")
        self.n_frames, self.fps = n_frames, fps
        self.speed, self.playing, self.loop, self._position = 1.0, False, True, 0.0

    @property
    def frame(self) -> int:
        """Number of the frame that is shown, from 0."""
        return min(int(self._position), self.n_frames - 1)

    def play(self) -> None:
        """Lets time pass; from the start where it stands at the end."""
        if not self.loop and self.frame == self.n_frames - 1:
            self._position = 0.0
        self.playing = self.n_frames > 1

    def pause(self) -> None:
        """Stops time."""
        self.playing = False

    def seek(self, frame: int) -> None:
        """Shows ``frame``. Raises InputError where there is no such frame."""
        if not 0 <= frame < self.n_frames:
            raise InputError(f"frame {frame}: there are {self.n_frames}, from 0")
        self._position = float(frame)

    def set_speed(self, speed: float) -> None:
        """Sets the speed. Raises InputError outside of SPEEDS."""
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise InputError(f"speed must be from {SPEEDS[0]:g} to {SPEEDS[1]:g}; got {speed}")
        self.speed = speed

    def advance(self, seconds: float) -> bool:
        """Lets ``seconds`` pass; whether another frame is shown now."""
        if not self.playing:
            return False
        before, self._position = self.frame, self._position + seconds * self.fps * self.speed
        if self._position >= self.n_frames:
            self.playing = self.loop
            self._position = self._position % self.n_frames if self.loop else self.n_frames - 1.0
        return self.frame != before

    def resize(self, n_frames: int) -> None:
        """Changes the number of frames; the frame that is shown stays where it still exists."""
        self._position, self.n_frames = float(min(self.frame, n_frames - 1)), n_frames


@dataclass(frozen=True)
class Layers:
    """What is drawn."""

    moving: bool = True  #: particles that may move
    frozen: bool = True  #: particles of the static background
    cameras: bool = True  #: cameras of the scene, with their images
    truth: bool = True  #: true image beside the predicted one
    coloring: str = COLORINGS[0]  #: one of COLORINGS
    size: float = 1.0  #: of the drawn Gaussians, relative to their own: small ones show single particles

    def __post_init__(self):
        check_one_of("coloring", self.coloring, COLORINGS)
        if not SIZES[0] <= self.size <= SIZES[1]:
            raise InputError(f"size must be from {SIZES[0]:g} to {SIZES[1]:g}; got {self.size}")


@dataclass(frozen=True)
class View:
    """A camera and what it recorded."""

    quat: np.ndarray  #: [4] (w, x, y, z), from the camera's axes (x right, y down, z forward) to those of the scene
    position: np.ndarray  #: [3] metres
    fov: float  #: vertical angle, radians
    aspect: float  #: width over height
    image: np.ndarray | None  #: uint8 [H, W, 3]; None beyond the end of the recording


class Target:
    """Frames of Gaussians, with the particles that they are drawn from and the recorded scene where these are known.

    Attributes:
        name: shown as the title.
        fps: frames a second.
        particles: one cloud a frame; empty where only Gaussians are known.
        scene: recorded scene; None: there is none.
        first: step of the scene that frame 0 shows.
        n_encoded: leading frames that come from images: their particles are not aligned from one to the next.
    """

    def __init__(
        self,
        name: str,
        fps: float,
        *,
        frames: Frames = (),
        draw: Callable[[Particles], Gaussians] | None = None,
        particles: Sequence[Particles] = (),
        scene: Scene | None = None,
        first: int = 0,
        n_encoded: int = 0,
        bounds: Callable[[int], Tensor] | None = None,
    ):
        """
        Args:
            frames: Gaussians of each; empty: they are drawn from ``particles``, or there are none.
            draw: Gaussians of particles.
            bounds: bounds of the errors of a frame's particles, [N] metres; 0 where they do not move.
        """
        self.name, self.fps, self.scene, self.first, self.n_encoded = name, fps, scene, first, n_encoded
        self._draw, self._bounds = draw, bounds
        self.replace(particles, frames)

    def replace(self, particles: Sequence[Particles], frames: Frames = ()) -> None:
        """Shows other particles from now on, and the Gaussians ``frames`` where they are not drawn."""
        self.particles, self._frames = list(particles), frames
        self.gaussians = functools.lru_cache(KEPT_FRAMES)(self._gaussians)
        self._fastest: float | None = None
        self._axes: tuple[Tensor, Tensor, Tensor] | None = None

    def _gaussians(self, frame: int) -> Gaussians | None:
        """Gaussians of a frame on the CPU; None where the target has none."""
        if self.particles and self._draw is not None:
            with torch.no_grad():
                return self._draw(self.particles[frame]).to("cpu")
        return self._frames[frame] if len(self._frames) else None

    @property
    def n_frames(self) -> int:
        """Number of frames: of particles, of files, or else of the recording."""
        if self.particles or len(self._frames):
            return len(self.particles) or len(self._frames)
        return 0 if self.scene is None else self.scene.n_steps - self.first

    @property
    def colorings(self) -> tuple[str, ...]:
        """Those of COLORINGS that the target has values for."""
        latents = bool(self.particles) and self.particles[0].dynamic_latents.shape[1] > 0
        moves = self.n_frames > 1 and self.gaussians(0) is not None
        known = (True, moves, bool(self.particles), latents, self._bounds is not None)
        return tuple(name for name, is_known in zip(COLORINGS, known, strict=True) if is_known)

    def displacements(self, frame: int) -> Tensor:
        """[N, 3] metres since the frame before; 0 where its particles are others."""
        now = self.gaussians(frame)
        before = self.gaussians(frame - 1) if frame > 0 and frame >= self.n_encoded else None
        if before is None or len(before.means) != len(now.means):
            return torch.zeros_like(now.means)
        return now.means - before.means

    def colors(self, frame: int, coloring: str) -> Tensor:
        """[N, 3] in [0, 1], of the Gaussians of a frame; not of "appearance", which their harmonics hold.

        Raises:
            InputError: the target has no values for this colouring.
        """
        if coloring not in self.colorings[1:]:
            raise InputError(f"{self.name} has no colours by {coloring}; it has {', '.join(self.colorings)}")
        return getattr(self, f"_colors_of_{coloring}")(frame)

    def _colors_of_velocity(self, frame: int) -> Tensor:
        if self._fastest is None:
            some = np.unique(np.linspace(0, self.n_frames - 1, 12).round().astype(int))
            speeds = [self.displacements(int(i)).norm(dim=1).numpy() for i in some]
            moving = np.concatenate([speed[speed > 0] for speed in speeds])
            self._fastest = float(np.quantile(moving, FASTEST)) if len(moving) else 1.0
        speed = (self.displacements(frame).norm(dim=1) / self._fastest).clamp(0, 1)
        return torch.from_numpy(turbo(speed.numpy()).astype(np.float32) / 255)

    def _colors_of_trust(self, frame: int) -> Tensor:
        largest = self._bounds(self.n_frames - 1).quantile(FASTEST).clamp(min=1e-9)
        colors = torch.from_numpy(turbo((self._bounds(frame) / largest).numpy()).astype(np.float32) / 255)
        colors[self.particles[frame].activity.cpu() == FROZEN] = torch.tensor(FROZEN_COLOR)
        return colors

    def _colors_of_activity(self, frame: int) -> Tensor:
        activity = self.particles[frame].activity.cpu()
        colors = torch.tensor(FROZEN_COLOR).repeat(len(activity), 1)
        colors[activity == DYNAMIC] = torch.tensor(AWAKE_COLOR)
        asleep = activity == ASLEEP
        if frame > 0 and frame >= self.n_encoded:  # a rollout leaves those asleep exactly where they were
            same = len(self.particles[frame - 1].means) == len(activity)
            asleep |= same & (activity == DYNAMIC) & (self.displacements(frame) == 0).all(1)
        colors[asleep] = torch.tensor(ASLEEP_COLOR)
        return colors

    def _colors_of_latents(self, frame: int) -> Tensor:
        if self._axes is None:
            latents = self.particles[max(0, self.n_encoded - 1)].dynamic_latents.detach().cpu().float()
            _, _, axes = torch.linalg.svd(latents - latents.mean(0), full_matrices=False)
            axes = axes[:3]
            sign = axes.gather(1, axes.abs().argmax(1, keepdim=True)).sign()
            axes = torch.nn.functional.pad((axes * sign).T, (0, 3 - len(axes)))
            values = (latents - latents.mean(0)) @ axes
            low, high = (torch.quantile(values[:1_000_000], q, 0) for q in (LATENT_RANGE, 1 - LATENT_RANGE))
            self._axes = axes, latents.mean(0) @ axes + low, (high - low).clamp(min=1e-9)
        axes, low, span = self._axes
        return ((self.particles[frame].dynamic_latents.detach().cpu().float() @ axes - low) / span).clamp(0, 1)

    def seen(self, frame: int, layers: Layers) -> Gaussians | None:
        """Gaussians of a frame as ``layers`` show them; None where the target has none."""
        gaussians = self.gaussians(frame)
        if gaussians is None:
            return None
        changes = {"scales": gaussians.scales * layers.size} if layers.size != 1 else {}
        if layers.coloring != "appearance":
            changes["sh"] = torch.from_numpy(dc_of(self.colors(frame, layers.coloring).numpy()))[:, None]
        gaussians = dataclasses.replace(gaussians, **changes)
        rows = self.rows(frame, layers)
        return gaussians if bool(rows.all()) else rows_of(gaussians, rows)

    def rows(self, frame: int, layers: Layers) -> Tensor:
        """bool [N], the Gaussians of a frame that ``layers`` show."""
        if not self.particles:
            return torch.ones(len(self.gaussians(frame).means), dtype=torch.bool)
        is_frozen = self.particles[frame].activity.cpu() == FROZEN
        return torch.where(is_frozen, torch.tensor(layers.frozen), torch.tensor(layers.moving))

    def export(self, path: str | Path, frames: Sequence[int], layers: Layers) -> str:
        """Writes what is seen of ``frames`` as ``gsim3d export`` does; returns one line about what was written.

        Raises:
            InputError: there are no Gaussians, ``path`` exists, or its format cannot hold them.
        """
        if self.gaussians(0) is None:
            raise InputError(f"{self.name} holds no Gaussians that could be written to {path}")
        seen, n_given = (self.seen(frame, layers) for frame in frames), sum(one < self.n_encoded for one in frames)
        return write_frames(path, seen, len(frames), fps=self.fps, start=n_given)

    def views(self, frame: int, cams: Sequence[int]) -> list[View]:
        """Cameras ``cams`` of the scene at a frame."""
        scene, step = self.scene, self.first + frame
        assert scene is not None
        cameras = scene.cameras_at(cams, [step])
        images = self._truth(frame, cams)
        found = []
        for i in range(len(cams)):
            to_world, K = torch.linalg.inv(cameras.viewmats[i].double()), cameras.Ks[i].tolist()
            quat, position = rotation_to_quat(to_world[None, :3, :3])[0].numpy(), to_world[:3, 3].numpy()
            fov, aspect = 2 * math.atan(cameras.height / 2 / K[1][1]), cameras.width / cameras.height
            aspect *= K[1][1] / K[0][0]
            image = None if images is None else images[i]
            found.append(View(quat, position, fov, aspect, image))
        return found

    def _truth(self, frame: int, cams: Sequence[int]) -> np.ndarray | None:
        """uint8 [V, H, W, 3]; None beyond the end of the recording."""
        step = self.first + frame
        if self.scene is None or step >= self.scene.n_steps:
            return None
        return self.scene.images(list(cams), [step])[0].permute(0, 2, 3, 1).numpy()

    def beside(self, frame: int, cam: int, layers: Layers) -> np.ndarray | None:
        """uint8 [H, W or 2 W, 3]: the true image of a camera, and beside it what this camera would see.

        Returns:
            None without a recorded scene; where there are no Gaussians the true image alone; black for what lies
            beyond the end of the recording.
        """
        if self.scene is None:
            return None
        truth, gaussians = self._truth(frame, [cam]), self.seen(frame, layers)
        images = [np.zeros((self.scene.height, self.scene.width, 3), np.uint8) if truth is None else truth[0]]
        if gaussians is not None:
            camera = self.scene.cameras_at([cam], [self.first + frame])
            images.append(picture(gaussians, camera))
        return np.concatenate(images, 1)

    def export_beside(self, path: str | Path, cam: int) -> str:
        """Writes all frames as a .mp4 or .html file, the truth of a camera beside them; returns one line about it.

        Raises:
            InputError: the scene lacks the camera, or ``path`` exists or has another suffix.
        """
        out, scene = new_output_path(path, "file", "--to"), self.scene
        if out.suffix.lower() not in (".mp4", ".html"):
            raise InputError(f"--scene: {path} holds no true images; write .mp4 or .html")
        if not 0 <= cam < scene.n_cams:
            raise InputError(f"--camera {cam}: {scene.path} has {scene.n_cams} cameras, from 0")
        pairs = [self.beside(frame, cam, Layers()) for frame in range(self.n_frames)]
        truth, predicted = np.split(np.stack(pairs), 2, axis=2)
        with_parents(out)
        if out.suffix.lower() == ".mp4":
            panels = {"truth": truth[:, None], "predicted": predicted[:, None]}
            write_video(out, clip_frames(panels, self.fps), self.fps)
        else:
            seen = scene.cameras_at([cam], [self.first])
            view = player.View(seen.viewmats[0].numpy(), seen.Ks[0].numpy(), seen.width, seen.height)
            frames = [self.gaussians(frame) for frame in range(self.n_frames)]
            player.write_player(out, frames, fps=self.fps, title=out.stem, view=view, truth=list(truth))
        rate = f"{self.n_frames} frames, {self.fps:g} a second"
        return f"{out}: {rate}, truth beside prediction; {out.stat().st_size / 1e6:.2f} MB"


def splatting_of(gaussians: Gaussians, unit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What a browser draws, in units of ``unit`` metres, with covariances that half precision holds.

    Returns:
        Centres [N, 3], covariances [N, 3, 3], colours [N, 3] in [0, 1] without view dependence, opacities [N, 1].
    """
    splats = splats_of(gaussians, None, Path("viewer"))
    if splats.antialiased:
        message = "antialiased Gaussians: the viewer draws small ones too bright; gsim3d export (.mp4, .html) does not"
        warnings.warn(message, FitWarning, stacklevel=2)
    rotations = rotation_matrices(torch.from_numpy(splats.quats)).numpy()
    scaled = rotations * np.clip(splats.scales / unit, *HELD)[:, None]
    rgbs = np.clip(colors_of(splats), 0, 1).astype(np.float32)
    return splats.means / unit, scaled @ scaled.transpose(0, 2, 1), rgbs, splats.opacities[:, None]


def unit_of(gaussians: Gaussians) -> float:
    """Metres that standard deviations are best counted in: their median is then in the middle of HELD."""
    median = float(gaussians.scales.median()) if len(gaussians.scales) else 0.0
    return median / (HELD[0] * HELD[1]) ** 0.5 if median > 0 else 1.0
