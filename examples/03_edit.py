"""Edits a scene while it is predicted: throws the body up, lowers the ground and repaints it.

python examples/03_edit.py runs/data/ball/0000
"""

import sys

import torch

from gsim3d import Simulator
from gsim3d.data import Scene
from gsim3d.effects.edits import Edit, Move, Recolor, Throw
from gsim3d.state import DYNAMIC

if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
    sys.exit(__doc__)
simulator = Simulator.from_pretrained("elastic-small")
scene = Scene.open(sys.argv[1])

edits = [
    Edit(0, Throw("moving", (0.0, 0.0, 0.03))),  # metres a step, added to the velocity
    Edit(1, Move("frozen", (0.0, 0.0, -0.1))),  # metres
    Edit(2, Recolor("moving", (0.8, 0.1, 0.1))),
]
with torch.no_grad():
    steps = simulator.predict(scene, steps=3, edits=edits).steps

for step, particles in enumerate(steps):
    moving = particles.activity == DYNAMIC
    heights = [float(particles.means[mask, 2].mean()) for mask in (moving, ~moving)]
    print(f"step {step}: body at {heights[0]:.3f} m, ground at {heights[1]:.3f} m")
