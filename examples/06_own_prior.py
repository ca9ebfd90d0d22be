"""An own prior: drag towards the wind, with a strength that is learned. Lists in YAML name it once it is defined.

python examples/06_own_prior.py
"""

from dataclasses import dataclass, replace

import torch

from gsim3d import Particles, presets
from gsim3d.dynamics import Dynamics
from gsim3d.io.settings import from_dict
from gsim3d.priors import Prior, PriorConfig


@dataclass(frozen=True)
class WindConfig(PriorConfig):
    type = "wind"
    velocity: tuple[float, float, float] = (0.02, 0.0, 0.0)  # metres a step
    drag: float = 0.1  # share of the difference to the wind that a step takes away, at first


class Wind(Prior, config=WindConfig):
    requires = ("inertia",)  # which knows velocities, and comes before

    def __init__(self, config):
        super().__init__(config)
        self.drag = torch.nn.Parameter(torch.tensor(config.drag))

    def move(self, motion, gains, ctx):
        wind = motion.inertial.new_tensor(self.config.velocity)
        return replace(motion, inertial=motion.inertial + self.drag * (wind - motion.inertial))


small = presets.tiny().dynamics
settings = {"priors": [{"type": "inertia", "radius": 0.2}, {"type": "wind", "velocity": [0.0, 0.05, 0.0]}]}
dynamics = Dynamics(from_dict(type(small), settings, "dynamics", small)).eval()

n = 200  # particles at rest, one scene
latents = torch.zeros(n, small.dynamic_latents), torch.zeros(n, small.static_latents)
state = Particles(
    means=1 + 0.2 * torch.rand(n, 3), opacities=torch.ones(n), dynamic_latents=latents[0], static_latents=latents[1],
    cu_rows=torch.tensor([0, n]), cloud_scene=torch.tensor([0]), cloud_step=torch.tensor([0]),
    activity=torch.zeros(n, dtype=torch.uint8), origin=torch.zeros(1, 3, dtype=torch.float64),
)  # fmt: skip
start = state.means.mean(0)
for _ in range(20):
    state = dynamics(state)
print("moved by", [round(x, 2) for x in (state.means.mean(0) - start).tolist()], "metres")
state.velocity.sum().backward()
print("learns its drag:", dynamics.priors.get("wind").drag.grad is not None)
