"""A model in which every effect can be on, a state of it, and what a spec makes of them."""

import dataclasses

import torch

from gsim3d.effects.spec import EffectsSpec
from gsim3d.nn.gaussian_head import RendererConfig
from gsim3d.presets import ModelConfig
from tests.dynamics.scenes import EXPLICIT
from tests.effects.counting import counted, entered
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator, target_cameras

EXPLICIT_CONFIG = ModelConfig(
    dataclasses.replace(CONFIG.encoder, explicit=True, dynamic_dim=4, sh_degree=1),
    dataclasses.replace(EXPLICIT, grid_size=0.1, scale_max=0.3),
    RendererConfig(latents=0, sh_degree=1, scale_min=0.001, scale_max=0.3),
)
ASYMMETRIC = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, background="asymmetric"))
MODELS = {"latent": CONFIG, "explicit": EXPLICIT_CONFIG, "asymmetric": ASYMMETRIC}


class Case:
    """spec -> the steps of a rollout and images of the last one; ``run`` also counts what was called for them."""

    def __init__(self, config=CONFIG, steps=(2,), n_steps=2):
        self.simulator, self.frames, self.n_steps = awake(make_simulator(config)), make_frames(steps), n_steps
        with torch.no_grad():
            self.state = self.simulator.encode(self.frames)
        self.state.clouds  # read once, before operations are counted
        self.cameras = target_cameras(self.frames, len(steps))

    @torch.no_grad()
    def __call__(self, spec: EffectsSpec, **options):
        plan = self.simulator.plan(spec)
        steps = self.simulator.rollout(self.state, self.n_steps, plan, **options)
        return steps, self.simulator._draw(steps[-1], self.cameras, plan=plan)

    def run(self, values: dict):
        """Counts of operations, and names of modules, that the spec of plain ``values`` calls for."""
        spec = EffectsSpec.from_dict(values)
        self(spec)  # constants of a device are made once
        with entered(self.simulator) as modules, counted() as count:
            self(spec)
        return count, modules
