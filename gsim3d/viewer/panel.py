"""The part of the live viewer's panel that simulates on: bodies, edits, and effects with their costs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from gsim3d.effects.edits import Edit
from gsim3d.effects.selection import KINDS
from gsim3d.errors import InputError
from gsim3d.state import FROZEN
from gsim3d.viewer.simulation import OPERATIONS, OfBody, Simulation, Switch, hit

if TYPE_CHECKING:
    from gsim3d.viewer.server import Viewer

STEPS = 12  # predicted at a time at first
HINTS = {"move": "metres", "duplicate": "metres from the particles to their copy", "throw": "metres a step, added"}
CHOOSING = "A click in the scene chooses a body. Effects count from the next simulated part on."


class SimulationPanel:
    """Controls of a simulation in a viewer."""

    def __init__(self, viewer: Viewer, simulation: Simulation):
        self._viewer, self._simulation, self._frame = viewer, simulation, -1
        self._bodies: dict = {}  # of the shown frame
        self._placed: tuple | None = None  # middle and sides of the box as it was put around the chosen body
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
            self._edits = gui.add_markdown("")
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
        options = {"initial_value": switch.now, "disabled": len(switch.settings) < 2, "hint": switch.why or None}
        handle = gui.add_dropdown(switch.name, tuple(switch.settings), **options)
        if handle.disabled and switch.why:
            gui.add_markdown(f"*{switch.name}: {switch.why}*")
        self._viewer.on(handle, lambda: self._simulation.choose(switch.name, handle.value))

    # What is edited

    def frame_shown(self, frame: int, is_new: bool = False) -> None:
        """Lists the bodies of a frame, also of the same where ``is_new``, and forgets the choice of others."""
        if frame == self._frame and not is_new:
            return
        is_same, self._frame, self._bodies = frame == self._frame, frame, self._simulation.bodies(frame)
        names = (*KINDS, *(f"body {body + 1}: {len(rows):,}" for body, rows in self._bodies.items()))
        chosen = self._which.value if self._which.value in (names if is_same else KINDS) else "moving"
        if chosen != self._which.value:
            self._inside.value = False
        self._which.options = names
        self._which.value = chosen
        self._edits.content = "\n".join(f"- {self._description(edit)}" for edit in self._simulation.edits)
        self._place()

    def _description(self, edit: Edit) -> str:
        frame, of = edit.step + self._simulation.target.n_encoded - 1, edit.operation.of
        which = f"body {of.body + 1}" if isinstance(of, OfBody) else of.which
        return f"frame {frame}: {edit.operation.name} {which}{' in the box' if of.box else ''}"

    def _check_paused(self) -> None:
        if self._viewer.timeline.playing:
            raise InputError("pause at the frame that is meant first")
        self.frame_shown(self._viewer.timeline.frame)

    def _body(self) -> int | None:
        """Number of the chosen body."""
        place = self._which.options.index(self._which.value) - len(KINDS)
        return list(self._bodies)[place] if place >= 0 else None

    def _choose(self) -> None:
        if (body := self._body()) is not None:
            self._check_paused()
            low, high = map(np.array, self._simulation.box_of(self._frame, body))
            self._middle.value, self._sides.value = tuple((low + high) / 2), tuple(high - low)
            self._placed = self._middle.value, self._sides.value
            self._inside.value = True
            self._place()

    def _pick(self, click: Any) -> None:
        """Chooses the body, or the background, that a click hits."""
        viewer, target = self._viewer, self._simulation.target
        viewer.timeline.pause()
        self._check_paused()
        frame = self._frame
        row = hit(target.gaussians(frame), target.rows(frame, viewer.layers), click.ray_origin, click.ray_direction)
        if row is None:
            return
        name = "frozen" if int(target.particles[frame].activity[row]) == FROZEN else "moving"
        for place, rows in enumerate(self._bodies.values(), len(KINDS)):
            if bool((rows == row).any()):
                name = self._which.options[place]
        self._inside.value = False
        self._which.value = name
        self._choose()
        self._place()

    def _place(self) -> None:
        self._middle.visible = self._sides.visible = self._inside.value
        box = self._box
        box.position, box.dimensions, box.visible = self._middle.value, self._sides.value, self._inside.value

    def _show_fields(self) -> None:
        name = self._edit.value
        self._color.visible, self._vector.visible = name == "recolor", name in HINTS
        self._vector.hint = HINTS.get(name)

    # What is done

    def _simulate(self) -> Callable[[], None]:
        """What predicts as the panel says now."""
        self._check_paused()
        corners, made, body = None, None, self._body()
        if self._inside.value and (body is None or (self._middle.value, self._sides.value) != self._placed):
            middle, half = np.array(self._middle.value), np.abs(self._sides.value) / 2
            corners = middle - half, middle + half
        if (name := self._edit.value) != "none":
            which = "all" if body is not None else self._which.value
            vector = np.array(self._color.value) / 255 if name == "recolor" else self._vector.value
            made = self._simulation.operation(name, which, vector, corners, body)
        effects = self._simulation.effects
        return partial(self._viewer.simulate_on, self._frame, int(self._steps.value), made, effects)

    def _measure(self) -> Callable[[], None]:
        self._viewer.timeline.pause()
        return partial(self._measured, self._viewer.timeline.frame)

    def _measured(self, frame: int) -> None:
        bar, now = self._progress, {switch.name: switch.now for switch in self._simulation.switches()}
        bar.visible = True
        try:
            found = self._simulation.costs(frame, lambda share: setattr(bar, "value", 100 * share))
        finally:
            bar.visible = False
        rows = [f"| {n} | {label}{' (on)' if now[n] == label else ''} | {ms:.1f} |" for n, label, ms in found]
        self._costs.content = "\n".join(["| effect | setting | ms a step |", "|:--|:--|--:|", *rows])
