"""Hybrid scenes: bodies of a MuJoCo model move particles of a learned scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch

from gsim3d.effects.actors import Actor
from gsim3d.effects.edits import Rotate
from gsim3d.effects.plan import Plan
from gsim3d.effects.selection import Selection
from gsim3d.envs.model import ActorRows
from gsim3d.errors import InputError
from gsim3d.simulator import Simulator
from gsim3d.state import DYNAMIC, Particles, append_step, last_steps, newest_clouds, with_velocity
from gsim3d.synth.mujoco_engine import check_solver, load_mujoco

if TYPE_CHECKING:
    import mujoco


class HybridScene:
    """A scene in which bodies of a MuJoCo model drive particles, and a simulator predicts all others.

    Particles of a body keep their places in its frame. The network sees the coming translation of a body, and its
    rotation one step later. Predicted particles do not act on MuJoCo.

    Args:
        simulator: predicts the other particles.
        state: last steps of one scene.
        model: MuJoCo model.
        data: its state at the newest step of ``state``; :meth:`step` advances it. Set ``data.ctrl`` in between.
        bodies: name of a body in ``model`` -> its particles, moving ones: a Selection or its ``which``.
        fps: steps a second of the simulator.
        plan: of the effects, without sleep. Default: that of ``simulator.plan``.

    Attributes:
        state: last steps of the scene; ``actor`` is the index of each particle's body in ``bodies``, or -1.
        data: state of MuJoCo.

    Raises:
        InputError: ``state`` has several scenes, a body does not exist or has no moving particles, two bodies share
            some, the plan has sleep, ``1 / fps`` is no multiple of MuJoCo's time step, or ``data`` is of another model.
    """

    def __init__(
        self,
        simulator: Simulator,
        state: Particles,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        bodies: Mapping[str, Selection | str],
        *,
        fps: float,
        plan: Plan | None = None,
    ):
        if data.signature != model.signature:
            raise InputError("data is of another MuJoCo model")
        self._substeps = max(1, round(1 / (fps * model.opt.timestep))) if 0 < fps < np.inf else 0
        if not abs(self._substeps * model.opt.timestep * fps - 1) <= 1e-6:  # also of NaN
            raise InputError(f"1 / fps must be a multiple of the time step {model.opt.timestep:g} s; got fps {fps:g}")
        if len(newest_clouds(state.clouds)) != 1:
            raise InputError("state must have one scene")
        self.plan = plan or simulator.plan()
        if self.plan.spec.dynamics.sleep is not None or simulator.config.dynamics.steps_per_call > 1:
            raise InputError("plan: driven particles need one without dynamics.sleep, and a model with one step a call")
        known = [model.body(number).name for number in range(model.nbody)]
        actor = torch.full_like(state.activity, -1, dtype=torch.int64)
        for number, (name, selection) in enumerate(bodies.items()):
            if name not in known:
                raise InputError(f"bodies: MuJoCo's model has no body {name!r}; it has {', '.join(known)}")
            chosen = (Selection(selection) if isinstance(selection, str) else selection).mask(state)
            if bool((state.activity[chosen] != DYNAMIC).any()):
                raise InputError(f"bodies: particles of {name} are frozen; select moving ones")
            if bool((actor[chosen] >= 0).any()):
                raise InputError(f"bodies: {name} shares particles with another body")
            actor = torch.where(chosen, number, actor)
        load_mujoco().mj_kinematics(model, data)  # where bodies are, also in data that no step has computed
        self.simulator, self.model, self.data = simulator, model, data
        self.state, self._bodies = dataclasses.replace(state, actor=actor), [known.index(name) for name in bodies]

    @torch.no_grad()
    def step(self) -> Particles:
        """Advances MuJoCo and the particles by one step. Returns the new particles.

        Raises:
            Unstable: MuJoCo warns of its state, which it then resets; lower its time step.
        """
        mujoco = load_mujoco()
        for warning in self.data.warning:
            warning.number = 0
        before, turned = (x[self._bodies].copy() for x in (self.data.xpos, self.data.xquat))
        mujoco.mj_step(self.model, self.data, self._substeps)
        mujoco.mj_kinematics(self.model, self.data)
        check_solver(self.data)
        after, turns = self.data.xpos[self._bodies], self.data.xquat[self._bodies]
        moved = [Actor(by[None], ActorRows(number=i)) for i, by in enumerate(torch.from_numpy(after - before))]
        step = self.simulator.rollout(self.state, 1, self.plan, actors=moved)[0]
        for number, (old, new) in enumerate(zip(turned, turns, strict=True)):
            local, turn = np.zeros(3), np.zeros(3)  # rotation vectors, in the body's frame before and in the world
            mujoco.mju_subQuat(local, new, old)
            mujoco.mju_rotVecQuat(turn, local, old)
            axis, angle = tuple(turn) if turn.any() else (0.0, 0.0, 1.0), np.degrees(np.linalg.norm(turn))
            turn = Rotate(ActorRows(number=number), axis, angle, tuple(after[number]))
            step = turn.apply(step, self.simulator.renderer)
        step = with_velocity(step, (step.actor >= 0)[:, None], step.means - last_steps(self.state, 1).means)
        self.state = append_step(self.state, step, self.plan.history)
        return step
