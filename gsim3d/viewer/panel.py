"""The part of the live viewer's panel that simulates on: bodies, edits, and effects with their costs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gsim3d.effects.selection import KINDS
from gsim3d.errors import InputError
from gsim3d.state import FROZEN
from gsim3d.viewer.simulation import OPERATIONS, Simulation, Switch, hit

if TYPE_CHECKING:
    from gsim3d.viewer.server import Viewer

STEPS = 12  # predicted at a time at first
HINTS = {"move": "metres", "duplicate": "metres from the particles to their copy", "throw": "metres a step, added"}
CHOOSING = "A click in the scene chooses a body. Effects count from the next simulated part on."


class SimulationPanel:
    """Controls of a simulation in a viewer."""

    def __init__(self, viewer: Viewer, simulation: Simulation):
        self._viewer, self._simulation, self._frame = viewer, simulation, -1
        self._bodies: list = []  # of the shown frame
        gui, scene = viewer.server.gui, viewer.server.scene
        middle = tuple(simulation.target.particles[0].means.median(0).values.tolist())
        with gui.add_folder("Simulate on"):
            self._which = gui.add_dropdown("Particles", tuple(KINDS), initial_value="moving", hint=CHOOSING)
            self._inside = gui.add_checkbox("Inside of the box", False)
            self._middle = gui.add_vector3("Middle", middle, step=0.001, visible=False)
            self._sides = gui.add_vector3("Sides", (0.5, 0.5, 0.5), step=0.001, visible=False)
            self._edit = gui.add_dropdown("Edit", ("none", *OPERATIONS))
            self._vector = gui.add_vector3("By", (0.0, 0.0, 0.1), step=0.01, visible=False)
            self._color = gui.add_rgb("Colour", (220, 40, 40), visible=False)
            self._steps = gui.add_number("Steps", STEPS, min=1, max=1000, step=1)
            button = gui.add_button("Simulate on from this frame")
        self._box = scene.add_box("/box", (255, 160, 0), self._sides.value, wireframe=True, visible=False)
        with gui.add_folder("Effects of the next part", expand_by_default=False):
            for switch in simulation.switches():
                self._add_switch(gui, switch)
            measure = gui.add_button("Measure what they cost", hint="predicts some steps with each setting")
            self._progress = gui.add_progress_bar(0.0, visible=False)
            self._costs = gui.add_markdown("")
        viewer.on(self._which, self._choose)
        for handle in (self._inside, self._middle, self._sides):
            viewer.on(handle, self._place)
        viewer.on(self._edit, self._show_fields)
        viewer.on(button, self._simulate, "on_click")
        viewer.on(measure, self._measure, "on_click")
        viewer.on(scene, self._pick, "on_click")

    def _add_switch(self, gui: Any, switch: Switch) -> None:
        is_fixed = len(switch.settings) < 2
        handle = gui.add_dropdown(
            switch.name, tuple(switch.settings), initial_value=switch.now, disabled=is_fixed, hint=switch.why or None
        )
        if is_fixed and switch.why:
            gui.add_markdown(f"*{switch.name}: {switch.why}*")
        self._viewer.on(handle, lambda: self._simulation.choose(switch.name, handle.value))

    # What is edited

    def frame_shown(self, frame: int) -> None:
        """Lists the bodies of a frame; a body that was chosen in another one is not chosen any more."""
        if frame == self._frame:
            return
        self._frame, self._bodies = frame, self._simulation.bodies(frame)
        names = [f"body {i + 1}: {len(rows):,}" for i, rows in enumerate(self._bodies)]
        chosen = self._which.value if self._which.value in KINDS else "moving"
        if chosen != self._which.value:
            self._inside.value = False
        self._which.options = (*KINDS, *names)
        self._which.value = chosen
        self._place()

    def _check_paused(self) -> None:
        if self._viewer.timeline.playing:
            raise InputError("pause at the frame that is meant first")

    def _rows(self) -> Any:
        return self._bodies[self._which.options.index(self._which.value) - len(KINDS)]

    def _choose(self) -> None:
        if self._which.value in KINDS:
            return
        self._check_paused()
        low, high = map(np.array, self._simulation.box_of(self._frame, self._rows()))
        self._middle.value, self._sides.value = tuple((low + high) / 2), tuple(high - low)
        self._inside.value = True
        self._place()

    def _pick(self, click: Any) -> None:
        """Chooses the body, or the background, that a click hits."""
        viewer, target = self._viewer, self._simulation.target
        viewer.timeline.pause()
        viewer.draw()
        frame = self._frame
        row = hit(target.gaussians(frame), target.rows(frame, viewer.layers), click.ray_origin, click.ray_direction)
        if row is None:
            return
        name = "frozen" if int(target.particles[frame].activity[row]) == FROZEN else "moving"
        for i, rows in enumerate(self._bodies):
            if bool((rows == row).any()):
                name = self._which.options[len(KINDS) + i]
        self._inside.value = False
        self._which.value = name
        self._choose()
        self._place()

    def _place(self) -> None:
        for handle in (self._middle, self._sides):
            handle.visible = self._inside.value
        box = self._box
        box.position, box.dimensions, box.visible = self._middle.value, self._sides.value, self._inside.value

    def _show_fields(self) -> None:
        name = self._edit.value
        self._color.visible, self._vector.visible = name == "recolor", name in HINTS
        self._vector.hint = HINTS.get(name)

    # What is done

    def _simulate(self) -> None:
        self._check_paused()
        corners = None
        if self._inside.value:
            middle, half = np.array(self._middle.value), np.abs(self._sides.value) / 2
            corners = middle - half, middle + half
        made, name = [], self._edit.value
        if name != "none":
            which, body = self._which.value, ()
            if which not in KINDS:
                known = self._simulation.target.particles[self._frame].body
                which, body = "moving", () if known is None else known[self._rows()[0]].tolist()
            vector = np.array(self._color.value) / 255 if name == "recolor" else self._vector.value
            made = [self._simulation.operation(name, which, vector, corners, body)]
        self._viewer.simulate_on(int(self._steps.value), made)

    def _measure(self) -> None:
        self._viewer.timeline.pause()
        frame, bar = self._viewer.timeline.frame, self._progress
        bar.visible = True
        try:
            found = self._simulation.costs(frame, lambda share: setattr(bar, "value", 100 * share))
        finally:
            bar.visible = False
        now = {switch.name: switch.now for switch in self._simulation.switches()}
        rows = [f"| {n} | {label}{' (on)' if now[n] == label else ''} | {ms:.1f} |" for n, label, ms in found]
        self._costs.content = "\n".join(["| effect | setting | ms a step |", "|:--|:--|--:|", *rows])
