"""An arm, simulated by MuJoCo, swings a copy of a ball through a scene in which the ball itself is predicted.

python examples/08_hybrid_scene.py runs/data/ball/0000
"""

import sys

import mujoco
import torch

from gsim3d import Simulator
from gsim3d.data import Scene
from gsim3d.effects.edits import Duplicate, Edit
from gsim3d.effects.selection import Selection
from gsim3d.envs import HybridScene
from gsim3d.state import DYNAMIC, concatenate

SPEED, REACH = 6.0, 0.8  # rad/s and metres of the arm

if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
    sys.exit(__doc__)
simulator = Simulator.from_pretrained("elastic-small")
scene = Scene.open(sys.argv[1])
with torch.no_grad():  # the history: a ball and its copy, both falling
    steps = simulator.predict(scene, steps=4, edits=[Edit(0, Duplicate(by=(REACH, 0.0, 0.0)))]).steps
state = concatenate(steps)

moving = steps[-1].means[steps[-1].activity == DYNAMIC]
split = (moving[:, 0].min() + moving[:, 0].max()) / 2
ball, copy = moving[moving[:, 0] < split].mean(0).tolist(), moving[moving[:, 0] > split].mean(0).tolist()
x, y, z = ball[0] + REACH / 2, ball[1] - REACH, copy[2]  # the hinge
model = mujoco.MjModel.from_xml_string(f"""<mujoco>
  <option timestep="{1 / (10 * scene.fps)}" gravity="0 0 0"/>
  <worldbody><body name="arm" pos="{x} {y} {z}">
    <joint name="hinge" axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 {copy[0] - x} {copy[1] - y} 0" size="0.02"/>
    <body name="hand" pos="{copy[0] - x} {copy[1] - y} 0"><geom type="sphere" size="0.1"/></body>
  </body></worldbody>
  <actuator><velocity joint="hinge" kv="100"/></actuator>
</mujoco>""")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)

of_copy = Selection("moving", ((split.item(), -9.0, -9.0), (9.0, 9.0, 9.0)))
hybrid = HybridScene(simulator, state, model, data, {"hand": of_copy}, fps=scene.fps)
data.ctrl[0] = SPEED
for number in range(6):
    particles = hybrid.step()
    free = (particles.activity == DYNAMIC) & (particles.actor < 0)
    ball, copy = (particles.means[mask].mean(0).numpy().round(2) for mask in (free, particles.actor == 0))
    print(f"step {number}: hand at {data.body('hand').xpos.round(2)} m, its particles at {copy}, the ball at {ball}")
