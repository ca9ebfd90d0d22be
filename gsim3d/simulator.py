"""The simulator: images -> particles -> particles of later steps -> images. The file to read first.

    simulator = Simulator.from_pretrained("elastic-small")
    state = simulator.encode(frames)                  # particles of the last steps of every scene
    plan = simulator.plan(EffectsSpec())              # what to compute, and what not
    steps = simulator.rollout(state, 12, plan)        # particles of the next 12 steps
    images = simulator.render(steps[-1], cameras)     # any camera, pixels and depth

A state holds the last steps of each scene (:class:`gsim3d.state.Particles`, clouds sorted by scene and step). Scenes
are packed, not padded: particle counts, numbers of views and lengths of history may all differ.

Every call takes ``on_invalid``, the policy for numbers that cannot be used (:mod:`gsim3d.numerics.policy`; default the
model's), and ``report``, which counts them (default ``simulator.report``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn

from gsim3d.cameras import Cameras, Frames, FrameSource
from gsim3d.cuda_graphs import Prediction
from gsim3d.dynamics import (
    Dynamics,
    FrozenContext,
    RestLog,
    Sleepers,
    append_step,
    concatenate,
    last_steps,
    rollout,
    rollout_in_parts,
)
from gsim3d.effects.actors import Actor, Actors
from gsim3d.effects.edits import Edit, by_step, structure_of
from gsim3d.effects.plan import Plan, by_plan, make_plan, unused_parameters
from gsim3d.effects.selection import any_mask
from gsim3d.effects.spec import EffectsSpec, OutputEffects, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.nn.gaussian_head import GaussianHead, render
from gsim3d.nn.multiview_encoder import Encoder, StaticShapes, pixel_rows
from gsim3d.numerics.policy import OnInvalid, check_on_invalid
from gsim3d.numerics.report import StabilityReport
from gsim3d.numerics.speed import Setting, predict
from gsim3d.numerics.validate import check_particles, drop_particles, validate_frames, validate_particles
from gsim3d.ops.curve import Pyramid
from gsim3d.ops.raster import Rendering
from gsim3d.presets import ModelConfig
from gsim3d.pretrained import loading
from gsim3d.state import DYNAMIC, FROZEN, Gaussians, Particles


class Simulator(nn.Module):
    """Encoder, dynamics and renderer of one model.

    Attributes:
        config: sizes of its parts.
        effects: what it was trained to simulate, the default of :meth:`plan`.
        inputs: what it was trained on; None: not known.
        setting: how :meth:`predict` computes.
        report: StabilityReport of the calls that were given no other.
        absent: parameters that the weights it was given lack; plans that read them are refused.
        draws_in_graphs: whether images can be part of a CUDA graph.
    """

    config_class: type[ModelConfig] = ModelConfig
    draws_in_graphs: bool = True

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.dynamics = Dynamics(config.dynamics)
        self.renderer = GaussianHead(config.renderer)
        self.effects, self.inputs, self.setting = EffectsSpec(), None, Setting()
        self.report = StabilityReport()
        self.absent: frozenset[str] = frozenset()

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, *, device: str = "cpu", speed: str = "exact") -> Simulator:
        """A trained simulator, ready to predict.

        Args:
            name_or_path: name of a simulator that comes with gsim3d (:func:`gsim3d.pretrained.names`), a run folder, a
                checkpoint folder or a .safetensors file.
            device: "cpu" or "cuda".
            speed: "exact", or "balanced" or "fast" where ``gsim3d profile`` tuned them for the checkpoint.
        Returns:
            The simulator, in evaluation mode.
        Raises:
            InputError: there is no such checkpoint, it is broken or one of the published model, ``device`` is not
                there, or ``speed`` was not tuned; the message says what to do.
        """
        return loading.load((cls,), name_or_path, device, speed)[0]

    def save_pretrained(self, folder: str | Path) -> Path:
        """Writes weights and configuration, for :meth:`from_pretrained`.

        Args:
            folder: is made, or replaced where it is a checkpoint.
        Returns:
            The folder.
        Raises:
            InputError: there is something else at this path; nothing is written.
            NumericalError: a weight is not finite; nothing is written.
        """
        return loading.save(self, Path(folder))

    @torch.no_grad()
    def predict(
        self,
        source: Frames | FrameSource | Particles,
        steps: int,
        plan: Plan | None = None,
        *,
        cameras: Cameras | None = None,
        background: Tensor | None = None,
        edits: Sequence[Edit] = (),
        wrap: Callable[[Callable], Callable] | None = None,
        log: RestLog | None = None,
    ) -> Prediction:
        """The future of scenes: :meth:`encode`, :meth:`rollout` and :meth:`render` as the simulator's ``setting`` says.

        Args:
            source: input images, or anything that gives them: :class:`gsim3d.data.Scene`, or an own class with a method
                ``input_frames(inputs)`` (:class:`gsim3d.cameras.FrameSource`), or particles that are encoded.
            steps: how many to predict, at least 1.
            plan: what to compute; None: that of :meth:`plan`, with particles inserted and removed as ``edits`` do.
            cameras: of the images of each step; None: none are drawn.
            background: [3] or [I, 3], of the images; default black.
            edits: changes of the scene on the way.
            wrap: as of :meth:`rollout`; not called where the setting replays a CUDA graph.
            log: as of :meth:`rollout`.
        Returns:
            Particles of the steps after the last input step, and their images.
        Raises:
            InputError: ``steps`` is below 1, the images have another size than those of the training, or an edit cannot
                be made.
        """
        if plan is None:
            plan = self.plan(dataclasses.replace(self.effects, structure=structure_of(edits)))
        return predict(self, source, steps, plan, cameras, background, edits, wrap=wrap, log=log)

    def encode(
        self,
        frames: Frames,
        *,
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
        shapes: StaticShapes | None = None,
    ) -> Particles:
        """Particles of all clouds of ``frames``: each pixel inside the masks becomes one.

        Args:
            frames: input images.
            on_invalid: policy for numbers that cannot be used; None: the model's.
            report: counts such numbers; None: ``self.report``.
            shapes: of :meth:`gsim3d.nn.multiview_encoder.Encoder.static_shapes`: nothing then waits for the device.
        Returns:
            The particles, cloud by cloud.
        Raises:
            InputError, NumericalError: ``frames`` cannot be read; the message names the field and where.
        """
        guard = self._guard("encode", on_invalid, report)
        config = guard.keywords["config"]
        if shapes is None:
            self.encoder.check(frames, pixels=config.on_invalid == "raise")
        frames, spoiled = validate_frames(frames, config, guard.keywords["report"], "encode")
        particles = self.encoder(frames, shapes, check=False)
        if spoiled is not None:
            particles = drop_particles(particles, pixel_rows(frames, spoiled, shapes))
        particles = guard(particles)
        n_views = None if shapes is None else len(frames.cameras) // particles.n_clouds
        particles = self.dynamics.observe(particles, frames, n_views)
        guard.keywords["report"].send()
        return particles

    def plan(self, spec: EffectsSpec | None = None) -> Plan:
        """What will be computed, and what will not.

        Args:
            spec: what the scene calls for; None: what the model was trained to simulate.
        Returns:
            The plan, which :meth:`step`, :meth:`rollout` and :meth:`render` take.
        Raises:
            UnsupportedEffect: this model cannot simulate an effect of ``spec``.
        """
        plan = make_plan(self.effects if spec is None else spec, self.config)
        names = (name for name, _ in self.named_parameters())
        unused = unused_parameters(plan, self.config, names)
        if needed := sorted(self.absent.difference(unused)):
            raise UnsupportedEffect(
                f"unsupported effects: they read {', '.join(needed)}, which the weights do not have"
            )
        return dataclasses.replace(plan, unused=unused)

    def step(
        self,
        state: Particles,
        plan: Plan | None = None,
        *,
        generator: torch.Generator | None = None,
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
    ) -> Particles:
        """The state one call of the dynamics later: each scene's oldest steps leave once the history is full.

        Args:
            state: last steps of every scene.
            plan: what to compute; None: that of :meth:`plan`. No particle sleeps: that is decided along a rollout.
            generator: randomness of training (drop path, curve shuffling); None: none.
            on_invalid: policy for numbers that cannot be used; None: the model's.
            report: counts such numbers; None: ``self.report``.
        Returns:
            The last steps of every scene, the new one included.
        """
        plan, guard = plan or self.plan(), self._guard("step", on_invalid, report)
        self._check(state, "step")
        state = guard(self._prepare(state, plan))
        step = self._predict(state, plan=plan, generator=generator, guard=guard)
        guard.keywords["report"].send()
        return append_step(state, step, plan.history)

    def rollout(
        self,
        state: Particles,
        n_steps: int,
        plan: Plan | None = None,
        *,
        plans: Sequence[Plan] | None = None,
        generator: torch.Generator | None = None,
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
        geometry: Callable[[Particles], Pyramid] | None = None,
        wrap: Callable[[Callable], Callable] | None = None,
        log: RestLog | None = None,
        edits: Iterable[Edit] = (),
        actors: Sequence[Actor] = (),
    ) -> list[Particles]:
        """The next ``n_steps`` steps, one :class:`Particles` each with one cloud a scene.

        The particles are those of the newest step of ``state`` throughout, but for edits.

        Args:
            state: last steps of every scene.
            n_steps: how many to predict.
            plan: as of :meth:`step`.
            plans: one for each scene, in place of ``plan``; each scene is computed as if it were alone, those with
                equal plans together.
            generator: as of :meth:`step`.
            on_invalid: policy for numbers that cannot be used; None: the model's.
            report: counts such numbers; None: ``self.report``.
            geometry: makes the geometry of each call of the dynamics from its history; None: ``dynamics.geometry``.
            wrap: the function that predicts the next steps from a history -> the one to call instead; None: that one.
            log: records which particles rested and were not computed.
            edits: changes of the scene on the way (:mod:`gsim3d.effects.edits`); they wake all particles.
            actors: particles that move as prescribed (:mod:`gsim3d.effects.actors`).
        Returns:
            Particles of each step.
        Raises:
            InputError: an edit cannot be made, and the message names its step and operation; ``plans`` are not as many
                as scenes; or actors cannot move as prescribed.
        Gradients:
            through all steps, also to displacements of actors.
        """
        if plans is not None:
            if actors:
                raise InputError("actors: scenes with plans of their own cannot have actors; give one plan")
            options = {"generator": generator, "on_invalid": on_invalid, "report": report, "edits": edits, "log": log}
            parts = [
                self.rollout(state.select_clouds(clouds), n_steps, one, geometry=geometry, wrap=wrap, **options)
                for one, clouds in by_plan(state, plans)
            ]
            return [concatenate(step) for step in zip(*parts, strict=True)]
        plan, guard = plan or self.plan(), self._guard("rollout", on_invalid, report)
        predict = partial(self._predict, plan=plan, generator=generator, guard=guard, geometry=geometry)
        predict = predict if wrap is None else wrap(predict)
        self._check(state, "rollout")
        state, steps = self._prepare(state, plan), []
        if actors:
            acting = self._acting(actors, state, plan, n_steps)
            state, predict = acting.state, acting.wrap(predict)
        structure = plan.spec.structure
        changes = by_step(edits, n_steps, insert=structure.insert, remove=structure.remove)
        for begin, end in pairwise(sorted({0, *changes, n_steps})):
            for edit in changes.get(begin, ()):
                state = edit.apply(state, self._colors)
            if begin in changes:
                state = self.dynamics.initialize(state)
            state = guard(state)
            steps += self._roll(predict, state, end - begin, plan, generator, log)
            if end < n_steps:
                state = last_steps(concatenate([state, *steps[begin:end][-plan.history :]]), plan.history)
        guard.keywords["report"].send()
        return steps

    def _acting(self, actors: Sequence[Actor], state: Particles, plan: Plan, n_steps: int) -> Actors:
        if plan.spec.dynamics.sleep is not None:
            raise InputError("actors: what they touch must not sleep; the plan has dynamics.sleep on")
        if self.config.dynamics.steps_per_call > 1:
            raise InputError("actors: this model predicts several steps a call, and actors need one")
        return Actors(actors, state, n_steps)

    def _roll(self, predict, state: Particles, n_steps: int, plan: Plan, generator, log) -> list[Particles]:
        """:meth:`rollout` of a state that is prepared, without edits."""
        config, rule, sleepers = self.config.dynamics, plan.spec.dynamics.sleep, None
        if rule is None and not config.is_asymmetric:
            return rollout(predict, state, n_steps, plan.history)
        if rule is not None:
            changing = [name for name, who in self._changes(plan).items() if who != "none"]
            sleepers = Sleepers(rule, last_steps(state, 1), config.grid_size, plan.history, changing)
        return rollout_in_parts(
            predict,
            state,
            n_steps,
            plan.history,
            remember=partial(self.dynamics.remember, generator=generator) if config.is_asymmetric else None,
            sleepers=sleepers,
            log=log,
        )

    def _prepare(self, state: Particles, plan: Plan) -> Particles:
        """What the dynamics reads of ``state``: its last steps, with the background as the plan wants it, and marks on
        the bodies that it names."""
        background, appearance = plan.spec.dynamics.background, plan.spec.appearance
        selections = () if appearance.changing == "none" else appearance.frozen_appearance
        if not selections and state.frozen_appearance is not None:
            state = dataclasses.replace(state, frozen_appearance=None)
        elif selections and state.frozen_appearance is None:
            frozen = any_mask(selections, state, "effects: appearance.frozen_appearance")
            state = dataclasses.replace(state, frozen_appearance=frozen)
        if background == "masked_out":
            state = state.select_rows(state.activity == DYNAMIC)
        if background == "dynamic":
            state = dataclasses.replace(state, activity=torch.where(state.activity == FROZEN, DYNAMIC, state.activity))
        state = last_steps(state, plan.history)
        return self.dynamics.begin(self.dynamics.initialize(state))

    def render(
        self,
        particles: Particles,
        cameras: Cameras,
        background: Tensor | None = None,
        plan: Plan | None = None,
        *,
        plans: Sequence[Plan] | None = None,
        cutoff: str = "exact",
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
    ) -> Rendering:
        """Images of ``cameras``; camera i shows cloud ``cameras.image_cloud[i]`` of ``particles``.

        Args:
            particles: any clouds.
            cameras: I images.
            background: [3] or [I, 3], default black.
            plan: which images, and the degree of view-dependent colour; default colour as the model's, alpha and depth.
            plans: one for each scene, in place of ``plan``; all for the same outputs.
            cutoff: as :func:`gsim3d.ops.rasterize_gaussians`.
            on_invalid: policy for numbers that cannot be used; None: the model's.
            report: counts such numbers; None: ``self.report``.
        Returns:
            The images that the plan asks for.
        Raises:
            InputError: ``plans`` are not as many as scenes, or ask for different images.
        """
        if plans is not None:
            options = {"cutoff": cutoff, "on_invalid": on_invalid, "report": report}
            return self._render_by_plan(particles, cameras, background, plans, **options)
        guard = self._guard("render", on_invalid, report, in_workspace=False)
        self._check(particles, "render")
        image = self._draw(
            guard(particles), cameras, background, plan, cutoff=cutoff, on_invalid=on_invalid, report=report
        )
        guard.keywords["report"].send()
        return image

    def _draw(
        self,
        particles: Particles,
        cameras: Cameras,
        background: Tensor | None = None,
        plan: Plan | None = None,
        *,
        cutoff: str = "exact",
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
    ) -> Rendering:
        """As :meth:`render`, of particles as :meth:`rollout` returned them: their numbers are not looked at again."""
        on_invalid, report = on_invalid or self.config.stability.on_invalid, self.report if report is None else report
        outputs = plan.spec.outputs if plan else OutputEffects(depth=True, alpha=True)
        gaussians = self.renderer(particles, sh_degree=plan.sh_degree if plan else None, rgb=outputs.rgb)
        image = self._rasterized(
            gaussians,
            cameras,
            background,
            features=particles.latents if outputs.features else None,
            cutoff=cutoff,
            jacobian=self.config.renderer.jacobian,
            on_invalid=on_invalid,
            report=report,
        )
        asked = (outputs.rgb, outputs.alpha, outputs.depth, outputs.features)
        return Rendering(*(made if wanted else None for made, wanted in zip(image, asked, strict=True)))

    def _render_by_plan(
        self, particles: Particles, cameras: Cameras, background: Tensor | None, plans: Sequence[Plan], **options
    ) -> Rendering:
        if len({plan.spec.outputs for plan in plans}) > 1:
            raise InputError("plans: those of one batch must ask for the same images (outputs)")
        shown, order, images = cameras.image_cloud.tolist(), [], []
        for plan, clouds in by_plan(particles, plans):
            rows = [i for i, cloud in enumerate(shown) if cloud in clouds]
            chosen = torch.tensor(rows, device=cameras.near.device, dtype=torch.int64)
            image_cloud = torch.tensor([clouds.index(shown[i]) for i in rows], device=chosen.device, dtype=torch.int64)
            behind = background if background is None or background.dim() == 1 else background[chosen]
            selected = cameras.select(chosen, image_cloud)
            images.append(self.render(particles.select_clouds(clouds), selected, behind, plan, **options))
            order += rows
        back = torch.argsort(torch.tensor(order, device=cameras.near.device))
        fields = zip(*images, strict=True)
        return Rendering(*(None if parts[0] is None else torch.cat(parts)[back] for parts in fields))

    def _rasterized(self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None, **options) -> Rendering:
        return render(gaussians, cameras, background, **options)

    def _changes(self, plan: Plan) -> dict[str, str]:
        """Of each field that the dynamics predicts, whose values a step changes."""
        appearance = plan.spec.appearance
        return self.dynamics.layout.changes(appearance.changing, appearance.opacity_changes is not False)

    def _colors(self, particles: Particles) -> Tensor:
        """[N, 3], of the Gaussians, seen from nowhere in particular."""
        return 0.5 + SH_0 * self.renderer(particles, sh_degree=0).sh[:, 0]

    def _check(self, particles: Particles, where: str) -> None:
        """Raises where fields of ``particles`` are not what they must be."""
        config = self.config.dynamics
        widths = {"dynamic_latents": config.dynamic_latents, "static_latents": config.static_latents}
        check_particles(particles, where, next(self.parameters()).dtype, widths)

    def _guard(
        self, where: str, on_invalid: OnInvalid | None, report: StabilityReport | None, in_workspace: bool = True
    ) -> partial[Particles]:
        """validate_particles with the limits of this model."""
        limits, dynamics = self.config.stability, self.config.dynamics
        if on_invalid is not None:
            check_on_invalid(on_invalid)
            limits = dataclasses.replace(limits, on_invalid=on_invalid)
        report = self.report if report is None else report
        report.poll()
        return partial(
            validate_particles,
            config=limits,
            report=report,
            where=where,
            grid_size=dynamics.grid_size if in_workspace and dynamics.origin_of_scene else 0.0,
            max_opacity=dynamics.max_opacity,
        )

    def _predict(
        self,
        state: Particles,
        background: FrozenContext | None = None,
        *,
        plan: Plan,
        generator: torch.Generator | None,
        guard: Callable[..., Particles],
        geometry: Callable[[Particles], Pyramid] | None = None,
    ) -> Particles:
        """The next steps of every scene, guarded.

        background: what rests while ``state`` moves; None: all there is, is in the state.
        """
        changes = self._changes(plan)
        pyramid = None if geometry is None else geometry(state)
        options = {"pyramid": pyramid, "background": background, "changes": changes}
        step = self.dynamics(state, generator=generator, **options)
        newest = concatenate([last_steps(state, 1)] * self.config.dynamics.steps_per_call)
        changed = [name for name, who in changes.items() if who != "none"]
        return guard(step, previous=newest, changed=changed)
