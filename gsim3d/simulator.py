"""The simulator: images -> particles -> particles of later steps -> images. The file to read first.

    simulator = Simulator(presets.tiny())
    state = simulator.encode(frames)                  # particles of the last steps of every scene
    plan = simulator.plan(EffectsSpec())              # what to compute, and what not
    steps = simulator.rollout(state, 12, plan)        # particles of the next 12 steps
    images = simulator.render(steps[-1], cameras)     # any camera, pixels and depth

A state holds the last steps of each scene (:class:`gsim3d.types.Particles`, clouds sorted by scene and step). Scenes
are packed, not padded: particle counts, numbers of views and lengths of history may all differ.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import torch
from torch import Tensor, nn

from gsim3d.dynamics import Dynamics, append_step, concatenate, last_steps, rollout
from gsim3d.effects import EffectsSpec, Plan, make_plan
from gsim3d.encoder import Encoder
from gsim3d.ops.raster import Rendering
from gsim3d.presets import ModelConfig
from gsim3d.quirks import Quirks
from gsim3d.renderer import GaussianHead, render, render_as_published
from gsim3d.types import DYNAMIC, FROZEN, Cameras, Frames, Particles


class Simulator(nn.Module):
    """Encoder, dynamics and renderer of one model."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.dynamics = Dynamics(config.dynamics)
        self.renderer = GaussianHead(config.renderer)

    def encode(self, frames: Frames) -> Particles:
        """Particles of all clouds of ``frames``: each pixel that the masks keep becomes one."""
        return self.encoder(frames)

    def plan(self, spec: EffectsSpec = EffectsSpec()) -> Plan:
        """What will be computed for ``spec``, and what will not.

        Raises:
            UnsupportedEffect: this model cannot simulate an effect of ``spec``.
        """
        dynamics, renderer = self.config.dynamics, self.config.renderer
        plan = make_plan(
            spec,
            history=2**dynamics.history_bits,
            sh_degree=renderer.sh_degree,
            changes_opacity=dynamics.explicit,
        )
        merged = dynamics.pyramid_spec(dynamics.history_bits).merged_bits()
        unused = [
            f"dynamics.net.encoder.{s}.merge.time_embedding"
            for s, stage in enumerate(self.dynamics.net.encoder)
            if stage.merge is not None and merged[s] == 0
        ]
        return dataclasses.replace(plan, unused=tuple(unused))

    def step(
        self, state: Particles, plan: Plan | None = None, *, generator: torch.Generator | None = None
    ) -> Particles:
        """The state one call of the dynamics later: each scene's oldest steps leave once the history is full.

        Args:
            state: last steps of every scene.
            plan: what to compute; default everything the model can.
            generator: randomness of training (drop path, curve shuffling); None: none.
        """
        plan = plan or self.plan()
        state = last_steps(self._prepare(state, plan), plan.history)
        return append_step(state, self._predict(state, plan, generator), plan.history)

    def rollout(
        self,
        state: Particles,
        n_steps: int,
        plan: Plan | None = None,
        *,
        generator: torch.Generator | None = None,
    ) -> list[Particles]:
        """The next ``n_steps`` steps, one :class:`Particles` each with one cloud a scene.

        Rows are those of the newest step of ``state`` throughout. Gradients flow through all steps. Arguments as
        :meth:`step`.
        """
        plan = plan or self.plan()
        predict = partial(self._predict, plan=plan, generator=generator)
        return rollout(predict, self._prepare(state, plan), n_steps, plan.history)

    def render(
        self,
        particles: Particles,
        cameras: Cameras,
        background: Tensor | None = None,
        plan: Plan | None = None,
        *,
        cutoff: str = "exact",
    ) -> Rendering:
        """Images of ``cameras``; camera i shows cloud ``cameras.image_cloud[i]`` of ``particles``.

        Args:
            particles: any clouds.
            cameras: I images.
            background: [3] or [I, 3], default black.
            plan: limits the degree of view-dependent colour; default the model's.
            cutoff: as :func:`gsim3d.ops.rasterize_gaussians`.
        """
        gaussians = self.renderer(particles, sh_degree=plan.sh_degree if plan else None)
        quirks = self.config.renderer.quirks
        if quirks != Quirks():
            return render_as_published(gaussians, cameras, background, quirks=quirks)
        return render(gaussians, cameras, background, cutoff=cutoff)

    def _prepare(self, state: Particles, plan: Plan) -> Particles:
        """``state`` with the background as the plan wants it."""
        if plan.spec.dynamics.background == "masked_out":
            return state.select_rows(state.activity == DYNAMIC)
        if plan.spec.dynamics.background == "dynamic":
            return dataclasses.replace(state, activity=torch.full_like(state.activity, DYNAMIC))
        return state

    def _predict(self, state: Particles, plan: Plan, generator: torch.Generator | None) -> Particles:
        """The next steps of every scene, without the changes that the plan leaves out."""
        step = self.dynamics(state, generator=generator)
        appearance = plan.spec.appearance
        newest = concatenate([last_steps(state, 1)] * self.config.dynamics.steps_per_call)
        if appearance.changing != "all":
            held = (step.activity == FROZEN) | (appearance.changing == "none")
            latents = torch.where(held[:, None], newest.dynamic_latents, step.dynamic_latents)
            step = dataclasses.replace(step, dynamic_latents=latents)
            if step.sh is not None:
                step = dataclasses.replace(step, sh=torch.where(held[:, None, None], newest.sh, step.sh))
        if appearance.opacity_changes is False:
            step = dataclasses.replace(step, opacities=newest.opacities)
        return step
