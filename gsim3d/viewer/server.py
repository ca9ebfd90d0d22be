"""The live viewer in a browser, served by viser: controls, and what :mod:`gsim3d.viewer.live` says is to be drawn."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import queue
import socket
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.effects.edits import Operation
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError, NumericalError
from gsim3d.state import Gaussians, Particles
from gsim3d.viewer.live import SIZES, SPEEDS, Layers, Target, Timeline, splatting_of, unit_of
from gsim3d.viewer.panel import SimulationPanel
from gsim3d.viewer.simulation import Simulation

LOCAL, PUBLIC = "127.0.0.1", "0.0.0.0"
MOST_CAMERAS = 16  # of a scene that are drawn, spread evenly
TICK = 1 / 60  # seconds between looks at the clock
LEGEND = "velocity, trust: from blue, the least, to red; activity: orange is awake, blue asleep, grey frozen"
EXPORT = "on the machine of the server; must not exist yet. .ply, .splat, .spz, .glb, .usdc, .html, .mp4, ..."


def load_viser() -> Any:
    """The module viser. Raises InputError where it is not installed."""
    try:
        import viser
    except ImportError:
        raise InputError("gsim3d view needs the package viser: pip install 'gsim3d[viewer]'") from None
    return viser


def free_port(host: str, port: int = 0) -> int:
    """A port of ``host`` that is free: ``port``, or any where it is 0. Raises InputError where it is taken."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise InputError(f"--port {port}: {error.strerror}; leave it out to take a free one") from None
        return probe.getsockname()[1]


class Viewer:
    """A server that shows a target until it is closed. Use as a context.

    Attributes:
        timeline: which frame is shown.
        layers: what of it is drawn.
        address: for a browser.
        server: of viser.
    """

    def __init__(self, target: Target, simulation: Simulation | None = None, *, host: str = LOCAL, port: int = 0):
        """Serves at ``host``; ``simulation`` made the target and simulates on. Port 0 is a free one.

        Raises:
            InputError: viser is not installed, the target is empty, or the port is taken.
        """
        viser = load_viser()
        self._target, self._simulation, self._lock = target, simulation, threading.RLock()
        self.timeline, self.layers = Timeline(target.n_frames, target.fps), Layers()
        self.timeline.seek(max(0, target.n_encoded - 1) if simulation else 0)  # the first that can be simulated on
        n_cams = 0 if target.scene is None else target.scene.n_cams
        self._cams = sorted({i * n_cams // MOST_CAMERAS for i in range(MOST_CAMERAS)}) if n_cams else []
        self._unit = 1.0 if (first := target.gaussians(0)) is None else unit_of(first)
        self._splats, self._frusta, self._closed = None, {}, threading.Event()
        self._note, self._next, self._is_stale = "", deque(maxlen=1), False
        self._work, self._n_working = queue.SimpleQueue(), 0
        with contextlib.redirect_stdout(io.StringIO()):  # its banner
            self.server = viser.ViserServer(host, free_port(host, port), label=f"gsim3d: {target.name}", verbose=False)
        self.address = f"http://{LOCAL if host == PUBLIC else host}:{self.server.get_port()}"
        self._look_at_target()
        self._add_controls()
        self.draw()
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._run, self._run_work)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops what is being simulated, and the server; its port is free again."""
        self._closed.set()
        if self._simulation is not None:
            self._simulation.is_closed = True
        self._work.put((None, None))
        for thread in self._threads:
            thread.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def wait(self) -> None:
        """Returns when the viewer is closed, for example by another thread."""
        while not self._closed.wait(1):
            pass

    def show(self, particles: list[Particles], frames: list[Gaussians], note: str) -> None:
        """Shows other frames of the same scene soon, and a note before the time; returns at once."""
        self._next.append((particles, frames, note))

    def _run(self) -> None:
        """Draws, where time passes or a user changed something."""
        before = time.monotonic()
        while not self._closed.wait(TICK):
            with self._lock, self._telling(*self.server.get_clients().values()):
                if self._next:
                    particles, frames, self._note = self._next.pop()
                    self._target.replace(particles, frames)
                    self._frames_changed()
                passed, before = time.monotonic() - before, time.monotonic()
                if self.timeline.advance(passed) or self._is_stale:
                    self._is_stale = False
                    try:
                        self.draw()
                    except Exception:
                        self._pause()
                        raise
                    before = before if self.timeline.playing else time.monotonic()

    def _run_work(self) -> None:
        """Does what takes long, in the order in which users asked for it."""
        while not self._closed.is_set():
            work, client = self._work.get()
            if work is None:
                return
            with self._telling(client):
                if said := work():
                    client.add_notification("Written", said, color="green")
            with self._lock:
                self._n_working, self._is_stale = self._n_working - 1, True

    @contextlib.contextmanager
    def _telling(self, *clients: Any) -> Iterator[None]:
        """Shows an error within it to ``clients``."""
        try:
            yield
        except Exception as error:
            is_known = isinstance(error, (InputError, NumericalError, OSError))
            said = str(error) if is_known else f"{type(error).__name__}: {error}"
            for client in clients:
                client.add_notification("Not possible", said, color="red")
            if not is_known:
                traceback.print_exc()

    def _look_at_target(self) -> None:
        """Where a browser begins: above and behind the first camera, or all Gaussians from the side."""
        camera, scene = self.server.initial_camera, self.server.scene
        scene.set_up_direction("+z")
        gaussians = self._target.gaussians(0)
        if self._cams:
            view = self._target.views(0, self._cams[:1])[0]
            cameras = self._target.scene.cameras_at(self._cams[:1], [self._target.first])
            forward, depth = cameras.viewmats[0, 2, :3].double().numpy(), float(cameras.near[0] + cameras.far[0]) / 2
            camera.position = view.position + depth * (np.array([0.0, 0.0, 0.4]) - 0.5 * forward)
            camera.look_at, self._frustum_size = view.position + depth * forward, 0.06 * depth
        elif gaussians is not None and len(gaussians.means):
            means = gaussians.means.double().numpy()
            middle = np.median(means, 0)
            ends = np.linalg.norm(means - middle, axis=1) + 3 * gaussians.scales.max(1).values.numpy()
            reach = max(float(np.quantile(ends, 0.95)), 1e-3)
            camera.position, camera.look_at = middle + reach * np.array([1.8, 1.0, 0.9]), middle

    # Controls. Callbacks run in the thread that receives messages, in their order; the lock is held to change anything.

    def _add_controls(self) -> None:
        gui, target, n = self.server.gui, self._target, self.timeline.n_frames
        with gui.add_folder("Time"):
            self._play = gui.add_button("Play", disabled=n < 2)
            self._frame = gui.add_slider("Frame", 0, max(n - 1, 1), 1, 0, disabled=n < 2)
            speed = gui.add_slider("Speed", *SPEEDS, 0.1, 1.0)
            loop = gui.add_checkbox("Loop", True)
            self._status = gui.add_markdown("")
        self.on(self._play, lambda: (self._pause if self.timeline.playing else self.timeline.play)(), "on_click")
        self.on(self._frame, lambda: self._seek(int(self._frame.value)))
        self.on(speed, lambda: self.timeline.set_speed(speed.value))
        self.on(loop, lambda: setattr(self.timeline, "loop", loop.value))
        with gui.add_folder("Layers"):
            shown = ["moving", "frozen"] if target.particles else []
            for name in shown + (["cameras", "truth"] if self._cams else []):
                box = gui.add_checkbox(name, True)
                self.on(box, partial(self._change_layer, name, box))
            if target.gaussians(0) is not None:
                self._coloring = coloring = gui.add_dropdown("Colours", target.colorings, hint=LEGEND)
                size = gui.add_slider("Size", *SIZES, 0.05, 1.0, hint="of the drawn Gaussians")
                self.on(coloring, partial(self._change_layer, "coloring", coloring))
                self.on(size, partial(self._change_layer, "size", size))
        self._beside = self._camera = None
        if self._cams:
            names = [f"{cam}: {target.scene.camera_names[cam]}" for cam in range(target.scene.n_cams)]
            with gui.add_folder("Truth | prediction" if target.gaussians(0) is not None else "Recorded"):
                self._camera = gui.add_dropdown("Camera", names)
                self._beside = gui.add_image(np.zeros((16, 16, 3), np.uint8), format="png")
            self.on(self._camera, lambda: None)
        if target.gaussians(0) is not None:
            with gui.add_folder("Export", expand_by_default=False):
                path = gui.add_text("File", "seen.ply", hint=EXPORT)
                what = gui.add_dropdown("Frames", ("the shown one", "all"), disabled=n < 2)
                write = gui.add_button("Write what is seen")
            self.on(write, lambda: self._export(path.value, what.value == "all"), "on_click")
        if self._simulation is not None:
            self._panel = SimulationPanel(self, self._simulation)

    def simulate_on(self, frame: int, n_steps: int, more: Operation | None, effects: EffectsSpec) -> None:
        """Predicts the frames after ``frame`` anew, with its edits and ``more`` (None: without) and ``effects``."""
        simulation = self._simulation
        part = simulation.predicted(frame, n_steps, simulation.operations(frame, more), effects)
        if self.layers.coloring == "trust":
            simulation.spread(part)
        with self._lock:
            simulation.take(part)
            self._frames_changed()

    def _frames_changed(self) -> None:
        self.timeline.resize(self._target.n_frames)
        self._frame.max = max(self.timeline.n_frames - 1, 1)
        self._frame.disabled = self._play.disabled = self.timeline.n_frames < 2
        if self._coloring.options != self._target.colorings:
            self._coloring.options = self._target.colorings
            self.layers = dataclasses.replace(self.layers, coloring=self._coloring.value)
        if self._simulation is not None:
            self._panel.frame_shown(self.timeline.frame, is_new=True)
        self._is_stale = True

    def on(self, handle: Any, act: Callable[..., Any], event: str = "on_update") -> None:
        """Calls ``act`` when a user changes ``handle``, or with the click in a scene; its error is shown there.

        ``act`` returns None, or what takes long: it is called later, after what was asked for before.
        """

        async def call(change: Any) -> None:
            if change.client is None or self._closed.is_set():  # changed by this class
                return
            with self._lock, self._telling(change.client):
                work = act(change) if handle is self.server.scene else act()
                if work is not None:
                    self._n_working += 1
                    self._work.put((work, change.client))
                self._is_stale = True

        register = getattr(handle, event)
        (register() if handle is self.server.scene else register)(call)

    def _pause(self) -> None:
        self.timeline.pause()
        self._play.label = "Play"

    def _seek(self, frame: int) -> None:
        self.timeline.pause()
        self.timeline.seek(frame)

    def _change_layer(self, name: str, handle: Any) -> Callable[[], None] | None:
        if handle.value == "trust":
            return partial(self._show_trust, handle)
        self.layers = dataclasses.replace(self.layers, **{name: handle.value})
        return None

    def _show_trust(self, handle: Any) -> None:
        for part in self._simulation.parts:
            self._simulation.spread(part)
        with self._lock:
            self.layers = dataclasses.replace(self.layers, coloring=handle.value)

    def _export(self, path: str, is_whole: bool) -> Callable[[], str]:
        frames = range(self._target.n_frames) if is_whole else [self.timeline.frame]
        return partial(self._target.export, Path(path).expanduser(), frames, self.layers)

    # Drawing

    def draw(self) -> None:
        """Sends the frame that is shown, all of it at one time."""
        with self._lock:
            frame = self.timeline.frame
            seen = self._target.seen(frame, self.layers)
            with self.server.atomic():
                splats = () if seen is None else splatting_of(seen, self._unit)
                if splats and self._splats is None:
                    self._splats = self.server.scene.add_gaussian_splats("/gaussians", *splats, scale=self._unit)
                elif splats:
                    self._splats.set_gaussians(*splats)
                self._draw_cameras(frame)
                if self._beside is not None:
                    self._beside.visible = self.layers.truth
                    if self.layers.truth:
                        cam = int(self._camera.value.partition(":")[0])
                        self._beside.image = self._target.beside(frame, cam, self.layers)
                self._frame.value = frame
                self._play.label = "Pause" if self.timeline.playing else "Play"
                self._status.content = self._description(frame, 0 if seen is None else len(seen.means))
                if self._simulation is not None and not self.timeline.playing:
                    self._panel.frame_shown(frame)

    def _description(self, frame: int, count: int) -> str:
        given = " (input)" if frame < self._target.n_encoded else ""
        text = f"{self._note}, " if self._note else ""
        text += f"{frame / self.timeline.fps:.2f} s, frame {frame} of {self.timeline.n_frames}{given}"
        text += f", {count:,} Gaussians" if count else ""
        if self._simulation is not None:
            text += f", {1000 * self._simulation.seconds_a_step:.0f} ms a simulated step"
        return f"{text}, **at work ({self._n_working} to do)**" if self._n_working else text

    def _draw_cameras(self, frame: int) -> None:
        if not self._cams:
            return
        if self.layers.cameras:
            for cam, view in zip(self._cams, self._target.views(frame, self._cams), strict=True):
                if cam not in self._frusta:
                    size = {"scale": self._frustum_size, "thickness": 0.04 * self._frustum_size}
                    add = self.server.scene.add_camera_frustum
                    self._frusta[cam] = add(f"/cameras/{cam}", view.fov, view.aspect, **size, format="jpeg")
                frustum = self._frusta[cam]
                frustum.wxyz, frustum.position, frustum.image = view.quat, view.position, view.image
        for frustum in self._frusta.values():
            frustum.visible = self.layers.cameras
