"""The simulator: images -> particles -> particles of later steps -> images. Start reading the library here.

    simulator = Simulator.from_pretrained("elastic-small")
    state = simulator.encode(frames)                  # particles of the last steps of every scene
    plan = simulator.plan(EffectsSpec())              # which effects to compute
    steps = simulator.rollout(state, 12, plan)        # particles of the next 12 steps
    images = simulator.render(steps[-1], cameras)     # colours and depth from any camera

A state contains the last steps of each scene (:class:`gsim3d.state.Particles`, clouds sorted by scene and step). Scenes
are packed, not padded: numbers of particles, views and history steps may differ between scenes.

Every method takes ``on_invalid``, the policy for invalid numbers (:mod:`gsim3d.numerics.policy`; default: the model's),
and ``report``, which counts them (default: ``simulator.report``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from gsim3d.cameras import Cameras, Frames, FrameSource
from gsim3d.cuda_graphs import Prediction
from gsim3d.dynamics import Dynamics, FrozenContext, RestLog, Sleepers, rollout, rollout_in_parts
from gsim3d.effects.actors import Actor, Actors
from gsim3d.effects.edits import Edit, by_step, structure_of
from gsim3d.effects.plan import Plan, by_plan, make_plan, unused_parameters
from gsim3d.effects.selection import any_mask
from gsim3d.effects.spec import EffectsSpec, OutputEffects, UnsupportedEffect
from gsim3d.errors import InputError, check_whole
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.nn.gaussian_head import GaussianHead, render
from gsim3d.nn.multiview_encoder import Encoder, StaticShapes, pixel_rows
from gsim3d.numerics.policy import OnInvalid, check_on_invalid
from gsim3d.numerics.report import StabilityReport
from gsim3d.numerics.rollout_graphs import RolloutGraphs
from gsim3d.numerics.speed import Setting, predict
from gsim3d.numerics.validate import check_particles, drop_particles, validate_frames, validate_particles
from gsim3d.ops.curve import Pyramid
from gsim3d.ops.raster import Rendering
from gsim3d.presets import ModelConfig
from gsim3d.pretrained import loading
from gsim3d.state import DYNAMIC, FROZEN, Gaussians, Newest, Particles, append_step, concatenate, last_steps


class Simulator(nn.Module):
    """The learned simulator: encoder, dynamics and renderer.

    Attributes:
        config: model configuration.
        effects: effects that the model was trained to simulate, the default of :meth:`plan`.
        inputs: input specification of the training; None if unknown.
        setting: speed setting of :meth:`predict`.
        trust: calibration of its errors (:class:`gsim3d.numerics.trust.Trust`); None: none was made.
        report: default StabilityReport of all methods.
        graphs: graph of the last rollout with ``graph="auto"``, :class:`gsim3d.numerics.rollout_graphs.RolloutGraphs`.
        absent: names of parameters missing in the loaded weights; plans that use them raise an error.
        draws_in_graphs: whether rendering can be captured in a CUDA graph.
    """

    config_class: type[ModelConfig] = ModelConfig
    draws_in_graphs: bool = True

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.dynamics = Dynamics(config.dynamics)
        self.renderer = GaussianHead(config.renderer)
        self.effects, self.inputs, self.setting, self.trust = EffectsSpec(), None, Setting(), None
        self.report, self.graphs = StabilityReport(), RolloutGraphs()
        self.absent: frozenset[str] = frozenset()

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, *, device: str = "cpu", speed: str = "exact") -> Simulator:
        """Loads a trained simulator.

        Args:
            name_or_path: name of a shipped simulator (:func:`gsim3d.pretrained.names`), run folder, checkpoint folder
                or .safetensors file.
            device: "cpu" or "cuda".
            speed: "exact", or "balanced" or "fast" if ``gsim3d profile`` tuned them for the checkpoint.

        Returns:
            The simulator in evaluation mode.

        Raises:
            InputError: the checkpoint does not exist, is damaged or is of the published model, ``device`` is not
                available, or ``speed`` was not tuned.
        """
        return loading.load((cls,), name_or_path, device, speed)[0]

    def save_pretrained(self, folder: str | Path) -> Path:
        """Saves weights and configuration, to be loaded with :meth:`from_pretrained`.

        Args:
            folder: folder to create; an existing checkpoint is replaced.

        Returns:
            The folder.

        Raises:
            InputError: the path exists and is not a checkpoint; nothing is written.
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
        """Predicts future steps of scenes: :meth:`encode`, :meth:`rollout` and :meth:`render` with ``self.setting``.

        Args:
            source: input frames, an object that provides them (:class:`gsim3d.cameras.FrameSource`, such as
                :class:`gsim3d.data.Scene`), or encoded particles.
            steps: number of steps to predict, at least 1.
            plan: plan of the effects. Default: that of :meth:`plan`, extended by the structural changes of ``edits``.
            cameras: cameras to render at every step. Default: no rendering.
            background: [3] or [I, 3], background colour. Default: black.
            edits: edits to apply during the rollout.
            wrap, log: see :meth:`rollout`.

        Returns:
            Particles of the steps after the last input step, and their images.

        Raises:
            InputError: ``steps`` is below 1, the image size differs from the training's, or an edit is invalid.
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
        """Encodes frames to particles, one for each pixel inside the masks.

        Args:
            frames: input frames.
            on_invalid: policy for invalid numbers. Default: the model's.
            report: counts invalid numbers. Default: ``self.report``.
            shapes: result of :meth:`gsim3d.nn.multiview_encoder.Encoder.static_shapes`, which avoids synchronisation
                with the device.

        Returns:
            Particles, packed by cloud.

        Raises:
            InputError, NumericalError: ``frames`` are invalid; the message names the field and location.
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
        """Compiles an effects specification to a plan of the required computations.

        Args:
            spec: effects to simulate. Default: those that the model was trained for.

        Returns:
            The plan, an argument of :meth:`step`, :meth:`rollout` and :meth:`render`.

        Raises:
            UnsupportedEffect: the model does not support an effect of ``spec``.
        """
        plan = make_plan(self.effects if spec is None else spec, self.config)
        names = (name for name, _ in self.named_parameters())
        unused = unused_parameters(plan, self.config, names)
        if needed := sorted(self.absent.difference(unused)):
            lacks = f"they require {', '.join(needed)}, which the weights do not contain"
            raise UnsupportedEffect(f"unsupported effects: {lacks}")
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
        """Advances the state by one call of the dynamics; drops the oldest steps once the history is full.

        Args:
            state: last steps of every scene.
            plan: plan of the effects. Default: that of :meth:`plan`. Particles are never put to sleep, because that is
                decided along a rollout.
            generator: random generator for training (drop path, curve shuffling). Default: no randomness.
            on_invalid, report: see :meth:`encode`.

        Returns:
            The last steps of every scene, including the new one.
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
        graph: Literal["auto"] | None = None,
    ) -> list[Particles]:
        """Predicts the next ``n_steps`` steps.

        Except for edits, all steps have the particles of the newest step of ``state``, in the same order.

        Args:
            state: last steps of every scene; ``state.actions`` are known motions of actors.
            n_steps: number of steps to predict.
            plan: see :meth:`step`.
            plans: one plan per scene, instead of ``plan``. Scenes with equal plans are batched; each result equals that
                of the scene alone.
            generator, on_invalid, report: see :meth:`step`.
            geometry: function history -> geometry of a call of the dynamics. Default: ``dynamics.geometry``.
            wrap: decorator of the function history -> next steps. Default: none.
            log: records which particles were at rest and skipped.
            edits: edits to apply during the rollout (:mod:`gsim3d.effects.edits`); they wake all particles.
            actors: kinematic particles that move as prescribed (:mod:`gsim3d.effects.actors`).
            graph: "auto" replays the rollout from a CUDA graph when calls with the same shapes repeat, on a GPU and
                without gradients; other calls run step by step, and ``self.graphs.obstacle`` says why. Default: step by
                step.

        Returns:
            Particles of each step, with one cloud per scene.

        Gradients:
            through all steps, also to displacements of actors.

        Raises:
            InputError: an edit or actor is invalid (the message names its step and operation), ``n_steps`` is no count,
                or the number of ``plans`` is not that of the scenes.
        """
        check_whole("rollout: n_steps", n_steps, 0)
        if plans is not None:
            if actors:
                raise InputError("actors: scenes with plans of their own cannot have actors; give one plan")
            options: dict[str, Any] = {"generator": generator, "on_invalid": on_invalid, "report": report}
            options |= {"geometry": geometry, "wrap": wrap, "edits": edits, "log": log}
            scenes = ((one, state.select_clouds(clouds)) for one, clouds in by_plan(state, plans))
            parts = [self.rollout(some, n_steps, one, **options) for one, some in scenes]
            return [concatenate(step) for step in zip(*parts, strict=True)]
        if graph not in (None, "auto"):
            raise InputError(f'rollout: graph must be "auto" or None; got {graph!r}')
        plan, guard = plan or self.plan(), self._guard("rollout", on_invalid, report)
        self._check(state, "rollout")
        if graph is not None:
            others: dict[str, Any] = {"edits": (edits := tuple(edits)), "actors": tuple(actors), "log": log}
            others |= {"generator": generator, "on_invalid": on_invalid, "geometry": geometry, "wrap": wrap}
            replayed = self.graphs.replayed(self, state, n_steps, plan, guard.keywords["report"], others)
            if replayed is not None:
                return replayed
        predict = partial(self._predict, plan=plan, generator=generator, guard=guard, geometry=geometry)
        predict = predict if wrap is None else wrap(predict)
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
        """Rolls out a prepared state, without edits."""
        config, rule, sleepers = self.config.dynamics, plan.spec.dynamics.sleep, None
        if rule is None and not config.is_asymmetric:
            return rollout(predict, state, n_steps, plan.history)
        if rule is not None:
            changing = [name for name, which in self._changes(plan).items() if which != "none"]
            sleepers = Sleepers(rule, last_steps(state, 1), config.grid_size, plan.history, changing)
        remember = partial(self.dynamics.remember, generator=generator) if config.is_asymmetric else None
        options = {"remember": remember, "sleepers": sleepers, "log": log}
        return rollout_in_parts(predict, state, n_steps, plan.history, **options)

    def _prepare(self, state: Particles, plan: Plan) -> Particles:
        """Prepares ``state`` for the dynamics: trims it to the history, and applies the plan's background mode and
        selections of frozen appearance."""
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
        active: Tensor | None = None,
        cutoff: str = "exact",
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
    ) -> Rendering:
        """Renders images; camera i shows cloud ``cameras.image_cloud[i]`` of ``particles``.

        Args:
            particles: particles of any clouds.
            cameras: cameras of I images.
            background: [3] or [I, 3], background colour. Default: black.
            plan: selects the outputs and the degree of view-dependent colour. Default: colour, alpha and depth, at the
                model's degree.
            plans: one plan per scene, instead of ``plan``, all with the same outputs.
            active: bool [I, H, W], pixels that are wanted, see :func:`gsim3d.ops.rasterize_gaussians`. Default: all.
            cutoff: see :func:`gsim3d.ops.rasterize_gaussians`.
            on_invalid, report: see :meth:`encode`.

        Returns:
            The outputs selected by the plan.

        Raises:
            InputError: the number of ``plans`` is not that of the scenes, or their outputs differ.
        """
        options: dict[str, Any] = {"active": active, "cutoff": cutoff, "on_invalid": on_invalid, "report": report}
        if plans is not None:
            return self._render_by_plan(particles, cameras, background, plans, **options)
        guard = self._guard("render", on_invalid, report, in_workspace=False)
        self._check(particles, "render")
        image = self._draw(guard(particles), cameras, background, plan, **options)
        guard.keywords["report"].send()
        return image

    def _draw(
        self,
        particles: Particles,
        cameras: Cameras,
        background: Tensor | None = None,
        plan: Plan | None = None,
        *,
        on_invalid: OnInvalid | None = None,
        report: StabilityReport | None = None,
        **options: Any,
    ) -> Rendering:
        """Renders like :meth:`render`, without validating ``particles``."""
        outputs = plan.spec.outputs if plan else OutputEffects(depth=True, alpha=True)
        options["on_invalid"] = on_invalid or self.config.stability.on_invalid
        options |= {"report": self.report if report is None else report, "jacobian": self.config.renderer.jacobian}
        options["features"] = particles.latents if outputs.features else None
        gaussians = self.renderer(particles, sh_degree=plan.sh_degree if plan else None, rgb=outputs.rgb)
        image = self._rasterized(gaussians, cameras, background, **options)
        asked = (outputs.rgb, outputs.alpha, outputs.depth, outputs.features)
        return Rendering(*(made if wanted else None for made, wanted in zip(image, asked, strict=True)))

    def _render_by_plan(
        self, particles: Particles, cameras: Cameras, background: Tensor | None, plans: Sequence[Plan], **options
    ) -> Rendering:
        if len({plan.spec.outputs for plan in plans}) > 1:
            raise InputError("plans: must have equal outputs")
        shown, order, images, active = cameras.image_cloud.tolist(), [], [], options.pop("active")
        for plan, clouds in by_plan(particles, plans):
            rows = [i for i, cloud in enumerate(shown) if cloud in clouds]
            chosen = torch.tensor(rows, device=cameras.near.device, dtype=torch.int64)
            image_cloud = torch.tensor([clouds.index(shown[i]) for i in rows], device=chosen.device, dtype=torch.int64)
            behind = background if background is None or background.dim() == 1 else background[chosen]
            selected = cameras.select(chosen, image_cloud)
            options["active"] = None if active is None else active[chosen]
            images.append(self.render(particles.select_clouds(clouds), selected, behind, plan, **options))
            order += rows
        back = torch.argsort(torch.tensor(order, device=cameras.near.device))
        fields = zip(*images, strict=True)
        return Rendering(*(None if parts[0] is None else torch.cat(parts)[back] for parts in fields))

    def _rasterized(self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None, **options) -> Rendering:
        return render(gaussians, cameras, background, **options)

    def _changes(self, plan: Plan) -> dict[str, str]:
        """Returns predicted attribute -> which particles a step changes ("all", "dynamic", "none")."""
        appearance = plan.spec.appearance
        return self.dynamics.layout.changes(appearance.changing, appearance.opacity_changes is not False)

    def _colors(self, particles: Particles) -> Tensor:
        """Returns the view-independent colours [N, 3] of the Gaussians."""
        return 0.5 + SH_0 * self.renderer(particles, sh_degree=0).sh[:, 0]

    def _check(self, particles: Particles, where: str) -> None:
        """Raises InputError if shapes or dtypes of ``particles`` are wrong."""
        config = self.config.dynamics
        widths = {"dynamic_latents": config.dynamic_latents, "static_latents": config.static_latents}
        check_particles(particles, where, next(self.parameters()).dtype, widths)

    def _guard(
        self, where: str, on_invalid: OnInvalid | None, report: StabilityReport | None, in_workspace: bool = True
    ) -> partial[Particles]:
        """Returns validate_particles with the limits of this model."""
        limits, dynamics = self.config.stability, self.config.dynamics
        if on_invalid is not None:
            check_on_invalid(on_invalid)
            limits = dataclasses.replace(limits, on_invalid=on_invalid)
        report = self.report if report is None else report
        report.poll()
        size = dynamics.grid_size if in_workspace and dynamics.origin_of_scene else 0.0
        bounds = {"grid_size": size, "max_opacity": dynamics.max_opacity}
        return partial(validate_particles, config=limits, report=report, where=where, **bounds)

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
        """Predicts the next steps of every scene, validated by ``guard``; ``background`` has the particles that
        ``state`` lacks. Others: see :meth:`rollout`."""
        changes, acting = self._changes(plan), state.actions is not None and plan.spec.dynamics.actions
        history = self.dynamics.actions.added(state, acting) if acting else state
        pyramid = None if geometry is None else geometry(history)
        options = {"pyramid": pyramid, "background": background, "changes": changes}
        newest = Newest(state)
        step = self.dynamics(history, generator=generator, newest=None if acting else newest, **options)
        step = self.dynamics.actions.removed(step) if acting else step
        previous = [newest()] * self.config.dynamics.steps_per_call
        previous = concatenate(previous) if len(previous) > 1 else previous[0]
        changed = [name for name, which in changes.items() if which != "none"]
        return guard(step, previous=previous, changed=changed)
