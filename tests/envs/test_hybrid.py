"""Hybrid scenes: particles of MuJoCo's bodies move exactly as these, and others are predicted."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsim3d.effects.selection import Selection
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep
from gsim3d.errors import InputError, NumericalError
from gsim3d.priors import InertiaConfig
from gsim3d.state import DYNAMIC, last_steps
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator

pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'gsim3d[envs]'")
mujoco = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'gsim3d[envs]'")
from gsim3d.envs import HybridScene  # noqa: E402
from gsim3d.envs.model import ActorRows  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")
XML = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="arm" pos="0.1 0 0.2">
  <joint name="shoulder" axis="0.2 0.3 1" damping="0.01"/><geom size="0.1" pos="0.3 0 0"/>
  <body name="hand" pos="0.3 0 0"><joint axis="1 0 0"/><geom size="0.1"/></body></body></worldbody>
  <actuator><velocity joint="shoulder" kv="1"/></actuator></mujoco>"""


def make(bodies=None, fps=10.0, frames=None, sleep=None):
    priors = dataclasses.replace(CONFIG.dynamics, priors=(InertiaConfig(),))
    simulator = awake(make_simulator(dataclasses.replace(CONFIG, dynamics=priors)))
    with torch.no_grad():
        state = simulator.encode(make_frames((2,)) if frames is None else frames)
    third = torch.arange(state.n_rows) % 3 - 1
    state = dataclasses.replace(state, actor=torch.where(state.activity == DYNAMIC, third, -1))
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = {"arm": ActorRows(number=0), "hand": ActorRows(number=1)} if bodies is None else bodies
    plan = simulator.plan(EffectsSpec(DynamicsEffects(sleep=sleep)))
    return HybridScene(simulator, state, model, data, bodies, fps=fps, plan=plan)


def test_names_of_selections_are_taken():
    scene = make({"arm": "moving"})
    assert ((scene.state.actor == 0) == (scene.state.activity == DYNAMIC)).all()


def test_particles_keep_their_places_in_the_frames_of_their_bodies():
    scene = make()
    scene.data.ctrl[0], scene.data.qvel[1] = 3.0, 2.0
    before = last_steps(scene.state, 1)

    def local(particles):
        places = [
            (particles.means[particles.actor == n].double() - torch.from_numpy(scene.data.body(name).xpos))
            @ torch.from_numpy(scene.data.body(name).xmat.reshape(3, 3).copy())
            for n, name in enumerate(("arm", "hand"))
        ]
        return torch.cat(places)

    first, at = local(before), scene.data.body("hand").xpos.copy()
    for _ in range(4):
        old = last_steps(scene.state, 1)
        step = scene.step()
        assert (local(step) - first).abs().max() < 1e-5
        driven = step.actor >= 0
        assert torch.equal(step.velocity[driven], (step.means - old.means)[driven])
    free = (step.actor < 0) & (step.activity == DYNAMIC)
    assert np.linalg.norm(scene.data.body("hand").xpos - at) > 0.05
    assert (step.means[free] - before.means[free]).abs().max() > 0 and scene.state.n_clouds > 2


def test_other_particles_see_the_bodies():
    moved = []
    for speed in (0.0, 3.0):
        scene = make()
        scene.data.ctrl[0] = speed
        moved.append(scene.step())
    free = moved[0].actor < 0
    assert not torch.equal(moved[0].means[free], moved[1].means[free])


@pytest.mark.parametrize(
    "options, words",
    [
        ({"bodies": {"foot": Selection()}}, "no body 'foot'; it has world, arm, hand"),
        ({"bodies": {"arm": Selection(), "hand": ActorRows(number=1)}}, "hand shares particles"),
        ({"bodies": {"arm": Selection("moving", ((9, 9, 9), (9, 9, 9)))}}, "the selection is empty"),
        ({"bodies": {"arm": Selection("frozen")}}, "particles of arm are frozen"),
        ({"sleep": Sleep()}, "plan: driven particles need one without dynamics.sleep"),
        ({"fps": 15.0}, "multiple of the time step"),
        ({"fps": 0.0}, "multiple of the time step 0.01 s; got fps 0"),
        ({"fps": math.nan}, "got fps nan"),
        ({"frames": make_frames((2, 2))}, "one scene"),
    ],
)
def test_wrong_arguments_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        make(**options)


def test_data_that_no_step_has_computed_moves_no_particle_at_first():
    scene = make()
    fresh = HybridScene(
        scene.simulator, scene.state, scene.model, mujoco.MjData(scene.model), {"arm": ActorRows(number=0)}, fps=10.0
    )
    before = last_steps(fresh.state, 1)
    moved = (fresh.step().means - before.means)[before.actor == 0]
    assert len(moved) and moved.abs().max() < 1e-6
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='arm'/></worldbody></mujoco>")
    with pytest.raises(InputError, match="of another MuJoCo model"):
        HybridScene(scene.simulator, scene.state, scene.model, mujoco.MjData(other), {}, fps=10.0)


@pytest.mark.parametrize("broken", [("qvel", 1e12), ("ctrl", math.nan)])
def test_a_state_that_mujoco_resets_is_an_error(broken):
    scene = make()
    getattr(scene.data, broken[0])[0] = broken[1]
    with pytest.raises(NumericalError):
        scene.step()
