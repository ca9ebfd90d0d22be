"""The training loop. A step is a function of (weights, configuration, step): a resumed run repeats it bit for bit."""

from __future__ import annotations

import math
import signal
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from gsim3d.data import Scene, generator, make_frames
from gsim3d.dynamics import concatenate
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError, NumericalError, RunStopped
from gsim3d.evaluate.perceptual.lpips import LPIPS
from gsim3d.evaluate.perceptual.weights import load
from gsim3d.io.locks import only_one_writer
from gsim3d.train import checkpoint
from gsim3d.train.captured import CapturedLoss, Gradients, Prepared
from gsim3d.train.checks import check_history, check_same_run, check_sharing
from gsim3d.train.config import StageConfig, TrainConfig
from gsim3d.train.log import Log, memory_gib, plain, progress_note
from gsim3d.train.losses import bodies_alone, time_weights
from gsim3d.train.optimizer import Optimizer
from gsim3d.train.parts import in_parts, with_first_background
from gsim3d.train.precision import FIRST_SCALE, LossScale, deterministic
from gsim3d.train.processes import Processes
from gsim3d.train.profile import check_profile, profiler
from gsim3d.train.recompute import recomputing
from gsim3d.train.restore import build_simulator, check_device, describe, keep_jacobian, model_config
from gsim3d.train.samples import Batch, check_scenes, context_cameras, draw_batch, history_at, spread_views, thinned
from gsim3d.train.schedule import one_cycle
from gsim3d.train.signals import noted_signals
from gsim3d.train.thawing import check_thawing, thaw
from gsim3d.train.training_loss import training_loss
from gsim3d.train.watch import Seen, StepWatch, first_not_finite, mean_of_norms, norms_by_module

READERS = 2  # threads that read batches; so many steps are read ahead
EMA_WARM_UP = 10  # the average forgets its first values: decay is at most (1 + step) / (10 + step)


class Trainer:
    """One training run in a folder: weights, optimizer and averaged weights at some step.

    Args:
        config: the run. A folder that already has a checkpoint must have been started with the same one.
        scenes: to train on, in a fixed order. More may come between two sittings, none may go; ``same_scenes`` is False
            where some came, for then the curve goes on as another one.
        out: run folder, made if absent.
        device: "cpu" or "cuda". A run may change it between two sittings; its numbers then change by rounding.
        processes: those that train together, see :func:`gsim3d.train.processes.joined`; each has a Trainer of its own,
            and the first one writes. Another number of them changes numbers by rounding, and what is drawn for drop
            path and shuffled curves; batch normalisation counts the rows of all.
    """

    def __init__(
        self,
        config: TrainConfig,
        scenes: Sequence[Scene],
        out: str | Path,
        *,
        device: str = "cpu",
        processes: Processes | None = None,
    ):
        check_device(device)
        self.device, self.processes = device, processes or Processes()
        check_scenes(scenes, config.data, config.all_stages)
        self.config, self.scenes, self.out = config, list(scenes), Path(out)
        self.plan_spec = EffectsSpec.from_dict(config.effects)
        self.simulator = build_simulator(model_config(config), config.seed).to(device)
        self.plan = self.simulator.plan(self.plan_spec)
        if not self.plan_spec.outputs.rgb:
            raise InputError("effects: outputs.rgb is off, but the loss compares colours; leave it on")
        check_history(config, self.plan)
        check_thawing(config.data, self.simulator.config.dynamics)
        check_sharing(config, self.processes.count, self.simulator.config.dynamics.norm)
        perceptual = load("lpips_vgg", partial(LPIPS, "vgg")).to(device) if config.loss.perceptual else None
        self.loss_of_steps = partial(training_loss, config.loss, perceptual)
        self.parameters = dict(self.simulator.named_parameters())
        self.buffers = dict(self.simulator.named_buffers())
        self.optimizer = Optimizer(self.parameters, config.optimizer)
        averaged = self.simulator.state_dict() if config.optimizer.ema_decay else {}
        self.average = {name: value.clone() for name, value in averaged.items()}
        self.scale = LossScale(FIRST_SCALE if config.precision.scales_loss else 1.0)
        self.step = self.n_skipped = self.n_skipped_in_a_row = 0
        self.seconds = 0.0
        self.parent = None
        self.same_scenes = True
        self._signals: list[int] = []
        self._stop: tuple[str, int] | None = None  # why, and the exit code
        self._ahead: dict[tuple, Future] = {}
        self._reader = ThreadPoolExecutor(READERS)
        if checkpoint.exists(self.out):
            self._resume()
        self.log = Log(self.out, writes=self.processes.is_first)
        self.log.cut(self.step)
        self.processes.check_agreement(
            **{"CONFIG": self.config, "--out": (self.step, self.parent), "--data": [s.name for s in self.scenes]}
        )
        self.captured = self._capture() if config.captured and device == "cuda" else None
        self.shared = self._share() if self.processes.count > 1 and self.captured is None else None

    def _share(self) -> DistributedDataParallel:
        """The loss of this process's samples; going back from it gives every process the gradient of all samples."""
        # Parts without gradients (the dynamics, in a stage that simulates nothing) are searched for in each step. Then
        # torch also leaves its buckets as they are: it would order them anew after the first step, and a resumed run
        # would add in another order. A group of its own, because batch normalisation talks at the same time.
        group = torch.distributed.new_group()
        # What torch 2.13 warns about has no other name in 2.11.
        with warnings.catch_warnings(category=FutureWarning, action="ignore"):
            return DistributedDataParallel(
                _Loss(self), broadcast_buffers=False, find_unused_parameters=True, process_group=group
            )

    def _capture(self) -> CapturedLoss:
        precision = partial(self.config.precision.of, device=self.device)
        return CapturedLoss(
            self.simulator,
            self.plan,
            self.loss_of_steps,
            precision,
            bodies=self.config.loss.bodies > 0,
            recompute=self.config.recompute,
        )

    def run(
        self,
        *,
        until: int | None = None,
        end: float = math.inf,
        progress: bool = True,
        tensorboard: bool = False,
        profile: bool = False,
    ) -> None:
        """Trains to the end of the configuration, or to optimizer step ``until``, and saves there.

        Args:
            end: on the clock of time.monotonic; then it saves and stops. For one process.
            tensorboard: also log for TensorBoard, with a sample video at each checkpoint.
            profile: write a trace of two steps.
        Raises:
            NumericalError: ``optimizer.max_skipped`` steps in a row were skipped; the message says what to do.
            RunStopped: after SIGINT, SIGTERM or SIGUSR1, or without its launcher, it saved and ended before ``until``.
        """
        until = self.config.n_steps if until is None else min(until, self.config.n_steps)
        self.out.mkdir(parents=True, exist_ok=True)
        self.simulator.train()
        self.processes.check_same(weights=self.parameters.values())
        shows = progress and self.processes.is_first
        bar = tqdm(total=until, initial=self.step, desc="training", unit="step", disable=None if shows else True)
        if profile:
            check_profile(until - self.step)
        tracer = profiler(self.out, self.processes.rank) if profile else nullcontext()
        lock = only_one_writer(self.out) if self.processes.is_first else nullcontext()
        log, signals = self.log.opened(tensorboard=tensorboard), noted_signals()
        with lock, bar, deterministic(), log, tracer, signals as self._signals:
            stops = self.step >= until
            while not stops:
                start = time.perf_counter()
                entry = self.train_step()
                spent = time.perf_counter() - start
                self.seconds += spent
                if self.processes.count == 1:  # else all have agreed on it within the step
                    self._stop = self._reason_to_stop()
                machine = {"seconds": self.seconds, "step_seconds": spent, "memory_gib": memory_gib(self.device)}
                if entry["step"] % self.config.log_every == 0 or "skipped" in entry or self.step == self.config.n_steps:
                    self.log.write(entry, machine)
                self._stop_if_diverged(entry)
                bar.set_postfix_str(progress_note(entry, machine), refresh=False)
                bar.update()
                if profile:
                    tracer.step()
                stops = self.step == until or time.monotonic() >= end or self._stop is not None
                if self.step % self.config.checkpoint_every == 0 or stops:
                    self.save()
                    if self.log.board is not None:
                        self.log.board.video(self.sample_video(), self.step)
        self.processes.check_same(weights=self.parameters.values())  # nobody goes on before the first one has saved
        if self._stop is not None and self.step < until:
            why, code = self._stop
            saved = f"step {self.step} of {self.config.n_steps} is saved in {self.out}"
            raise RunStopped(f"{why}: {saved}; the same command goes on from there", code)

    def train_step(self) -> dict:
        """One optimizer step; what to log of it.

        Where loss or gradient is not finite, or a number cannot be used, the step is skipped: weights, moments,
        averages and statistics stay as they are.
        """
        stage, place = self.config.stage_of(self.step)
        rate = self.learning_rate(stage, place)
        statistics = [(buffer, buffer.clone()) for buffer in self.buffers.values()]
        entry = {"step": self.step, "loss": math.nan, "learning_rate": rate, "grad_norm": math.nan}
        n_past = 0 if stage.dynamics_alone else history_at(self.config.data, stage, self.config.seed, self.step)
        errors = torch.full((n_past + stage.horizon,), math.nan)
        try:
            loss, errors, gradients, norm, seen = self._whole_batch(stage.batch)
            problem = self._look_at(entry, loss, gradients, norm, seen)
        except NumericalError as error:
            problem = str(error)
        if problem is None:
            self.optimizer.update(gradients, norm, rate)
            self._update_average(gradients)
            self.n_skipped_in_a_row = 0
        else:
            with torch.no_grad():
                for buffer, before in statistics:
                    buffer.copy_(before)
            self.n_skipped += 1
            self.n_skipped_in_a_row += 1
            entry["skipped"] = problem
        if self.config.precision.scales_loss and math.isfinite(entry["loss"]):
            entry["loss_scale"] = self.scale.value
            self.scale.update(math.isfinite(entry["grad_norm"]))
        if n_past:
            entry["past_psnr"] = _psnr(errors[:n_past])
        if stage.horizon:
            entry["future_psnr"] = _psnr(errors[n_past:])
        self.step += 1
        return {name: plain(value) for name, value in entry.items()}

    def learning_rate(self, stage: StageConfig, place: int) -> float:
        """Of the step at ``place`` of a stage."""
        return one_cycle(place, stage.steps, stage.learning_rate, stage.warm_up)

    def _whole_batch(self, batch: int) -> tuple[float, Tensor, Sequence[Tensor | None], Tensor, list[Seen]]:
        """Loss, errors by step, gradients of the whole batch and their norm; what was seen in each of its parts."""
        scale, norm = self.scale.value, None
        norms_scale = scale if self._is_logged else None
        if self.processes.count > 1:
            samples = self.processes.share(batch)
            compute = self._shared_gradients if self.captured is None else self._own_gradients
            loss, errors, gradients, watch, error = compute(samples)
            seen = Seen(error=error) if error else watch.seen(norms_scale)
            mine = (loss.item(), errors.cpu(), len(samples) / batch, seen, self._reason_to_stop())
            parts = self.processes.gather(mine)
            losses, errors, shares, seen, reasons = zip(*parts, strict=True)
            self._stop = next(filter(None, reasons), None)
            for rank, part in enumerate(seen):
                if part.error:
                    raise NumericalError(f"process {rank}: {part.error}")
            loss = sum(loss * share for loss, share in zip(losses, shares, strict=True))
            errors = sum(values * share for values, share in zip(errors, shares, strict=True))
            if self.captured is not None:
                gradients = self.processes.add(gradients, len(samples) / batch)
        elif self.captured is not None:
            watch = StepWatch()
            found = self._captured_gradients(list(range(batch)), watch)
            gradients, norm, seen = found.parameters, found.norm / scale, [watch.seen(norms_scale)]
            loss, errors = found.loss.item() / scale, found.errors.cpu()
        else:
            samples = list(range(batch))
            groups = [[sample] for sample in samples] if self.config.workers else [samples]
            results = self._map(self._gradients, groups)
            loss, errors, gradients = _mean([result[:3] for result in results])
            loss, seen = loss.item(), [watch.seen(norms_scale) for *_, watch in results]
        if self.config.stage_of(self.step)[0].dynamics_alone:
            pairs = zip(self.parameters, gradients, strict=True)
            gradients = [gradient if name.startswith("dynamics.") else None for name, gradient in pairs]
        if scale != 1:
            gradients = [None if gradient is None else gradient / scale for gradient in gradients]
        if norm is None:
            norm = torch.nn.utils.get_total_norm([gradient for gradient in gradients if gradient is not None])
        return loss, errors, gradients, norm, list(seen)

    def _reason_to_stop(self) -> tuple[str, int] | None:
        """Why this process should save and end, and its exit code then."""
        if self._signals:
            return signal.Signals(self._signals[0]).name, 128 + self._signals[0]
        return (self.processes.lost, 2) if self.processes.lost else None

    def _look_at(self, entry: dict, loss: float, gradients: Sequence, norm: Tensor, seen: list[Seen]) -> str | None:
        """Fills in ``entry``; why the gradients cannot be used, or None."""
        named = dict(zip(self.parameters, gradients, strict=True))
        if self._is_logged:
            entry["grad_norm_by_module"] = norms_by_module(named)
        entry["loss"] = loss
        entry["grad_norm"] = norm.item()
        if self._is_logged and (by_step := mean_of_norms([part.norms for part in seen])):
            entry["grad_norm_by_step"] = by_step
        entry["particles"] = sum(part.n_rows for part in seen) / max(1, sum(part.n_clouds for part in seen))
        if total := sum(part.n_unusable for part in seen):
            entry["unusable_rows"] = total
        if errors := [part.error for part in seen if part.error]:
            return errors[0]
        if not math.isfinite(entry["loss"]):
            return "the loss is not finite"
        if not math.isfinite(entry["grad_norm"]):
            return f"the gradient is not finite, first that of {first_not_finite(named.items())}"
        return None

    @property
    def _is_logged(self) -> bool:
        return self.step % self.config.log_every == 0

    def _stop_if_diverged(self, entry: dict) -> None:
        n, limit = self.n_skipped_in_a_row, self.config.optimizer.max_skipped
        if n < limit:
            return
        found = checkpoint.exists(self.out)
        good = f"its last checkpoint in {self.out}" if found else "its start: no checkpoint was written yet"
        raise NumericalError(
            f"training: {n} steps in a row were skipped up to step {entry['step']}, "
            f"the last because {entry['skipped']}; lower stages.learning_rate or optimizer.clip_norm and train again: "
            f"the run goes on from {good}",
            step=entry["step"],
        )

    def _map(self, f: Callable, groups: list) -> list:
        """f of every group, in order; with workers, several at a time."""
        n_workers = min(self.config.workers, len(groups), torch.get_num_threads())
        if n_workers < 2:
            return [f(group) for group in groups]
        n_threads = torch.get_num_threads()
        try:
            with ThreadPoolExecutor(n_workers, initializer=partial(_start_worker, n_threads // n_workers)) as pool:
                return list(pool.map(f, groups))
        finally:
            torch.set_num_threads(n_threads)

    def _gradients(self, samples: list[int]) -> tuple[Tensor, Tensor, tuple[Tensor | None, ...], StepWatch]:
        """Loss, errors by step, the gradient of the loss for every parameter (None where it has no part), and what was
        seen on the way."""
        watch, batch = StepWatch(), self._batch(samples)
        loss, errors = self.loss(batch, samples[0], watch)
        gradients = torch.autograd.grad(loss * self.scale.value, list(self.parameters.values()), allow_unused=True)
        return loss.detach(), errors, gradients, watch

    def _captured_gradients(self, samples: list[int], watch: StepWatch) -> Gradients:
        """Loss, errors and gradients from a CUDA graph, times the scale; the next call overwrites them."""
        prepared = self._prepared(samples)
        watch.count(sum(prepared.counts), len(prepared.counts))
        return self.captured(prepared, self.step_weights(prepared.batch) * self.scale.value, watch.report)

    def _prepared(self, samples: list[int]) -> Prepared:
        return self.captured.prepare(self._batch(samples))

    def _shared_gradients(self, samples: list[int]) -> tuple:
        """As :meth:`_gradients`, but gradients are those of the samples of all processes; and what is wrong with this
        one's, or None."""
        stage, _ = self.config.stage_of(self.step)
        # One that raises within a step leaves the others waiting: what cannot be used is dropped, and told afterwards.
        watch, error = StepWatch(strict=self.simulator.config.stability.on_invalid == "raise"), None
        try:
            loss, errors = self.shared(self._batch(samples), samples[0], watch)
        except NumericalError as found:  # the others wait for gradients all the same
            error = str(found)
            loss, errors = self.shared()
        for parameter in self.parameters.values():
            parameter.grad = None
        (loss * (self.scale.value * len(samples) * self.processes.count / stage.batch)).backward()
        gradients = [parameter.grad for parameter in self.parameters.values()]
        return loss.detach(), errors, gradients, watch, error

    def _own_gradients(self, samples: list[int]) -> tuple:
        """As :meth:`_shared_gradients`, from a CUDA graph, but gradients are those of this process's samples."""
        watch = StepWatch()
        try:
            found = self._captured_gradients(samples, watch)
        except NumericalError as error:  # the others wait
            nothing = torch.full((), math.nan)
            return nothing, nothing, (), watch, str(error)
        return found.loss / self.scale.value, found.errors, found.parameters, watch, None

    def _batch(self, samples: list[int]) -> Batch:
        """The samples of this step; those of the next ones are read meanwhile."""
        now, *later = ((step, tuple(samples)) for step in range(self.step, self.step + 1 + READERS))
        known = self._ahead.pop(now, None)
        for key in list(self._ahead):
            if key[0] < self.step:  # read in vain: the next stage has other batches
                self._ahead.pop(key, None)
        for key in later:
            if key[0] < self.config.n_steps and key not in self._ahead:
                self._ahead[key] = self._reader.submit(self._draw, *key)
        return (self._draw(*now) if known is None else known.result()).to(self.device)

    def _draw(self, step: int, samples: Sequence[int]) -> Batch:
        stage, _ = self.config.stage_of(step)
        return draw_batch(self.scenes, self.config.data, stage, self.config.seed, step, samples)

    def loss(self, batch: Batch, sample: int = 0, watch: StepWatch | None = None) -> tuple[Tensor, Tensor]:
        """The loss of a batch, and each step's unweighted mean squared error; ``sample`` numbers the randomness."""
        watch = watch or StepWatch()
        return self.loss_of_steps(*self._steps(batch, sample, watch), batch.targets, self.step_weights(batch))

    def step_weights(self, batch: Batch) -> Tensor:
        """Weight of each step of a batch, on its device."""
        settings = self.config.loss
        weights = time_weights(batch.n_context, batch.n_future, balance=settings.balance, discount=settings.discount)
        if batch.dynamics_alone:
            weights = weights[batch.n_context :]
            weights = weights / weights.sum()
        return weights.to(self.device)

    def _steps(self, batch: Batch, sample: int, watch: StepWatch) -> tuple:
        """What the target cameras of a batch should have seen, and of bodies alone if the loss wants it; where the
        simulation begins, and its steps. Each part of the model in its precision."""
        simulator, precision = self.simulator, self.config.precision
        again = recomputing(self.config.recompute, simulator)
        options = {"report": watch.report, "on_invalid": "drop" if watch.strict else None}
        rng = generator(self.config.seed, self.step, sample, "dynamics")
        noise = torch.Generator().manual_seed(int(rng.integers(2**63)))

        with precision.of("encoder", self.device), torch.set_grad_enabled(not batch.dynamics_alone):
            particles = again("encoder")(lambda context: simulator.encode(context, **options))(batch.context)
        watch.count(particles.n_rows, particles.n_clouds)
        if batch.has_own_background:
            particles = with_first_background(particles, simulator.dynamics)
        begin, steps = particles, []
        if batch.n_future:
            if self.config.data.thawed:
                rng = generator(self.config.seed, self.step, sample, "thawed")
                particles = thaw(particles, self.config.data.thawed, self.plan_spec, rng)
            with precision.of("dynamics", self.device):
                begin = particles
                if batch.n_lead:
                    with torch.no_grad():
                        ahead = simulator.rollout(particles, batch.n_lead, self.plan, generator=noise, **options)
                        begin = concatenate([particles, *ahead])
                begin = simulator.prepare(begin, self.plan)
                options_of_steps = {"generator": noise, "wrap": again("steps", noise), **options}
                rollout = partial(simulator.rollout, plan=self.plan, **options_of_steps)
                steps = in_parts(rollout, begin, batch.n_future, batch.cut)
            if self._is_logged:
                watch.follow(steps)
            particles = concatenate(steps if batch.dynamics_alone else [particles, *steps])
        with precision.of("renderer", self.device):
            render = again("images")(
                lambda p: simulator.render(p, batch.targets.cameras, plan=self.plan, **options).color
            )
            images = render(particles)
            bodies = render(bodies_alone(particles)) if self.config.loss.bodies and steps else None
        watch.report.close()  # what the backward pass computes again would be counted twice
        return images, bodies, begin, steps

    @torch.no_grad()
    def sample_video(self) -> Tensor:
        """uint8 [T, H, 2 W, 3]: the first window of the first scene seen by one camera, filmed and predicted."""
        stage, _ = self.config.stage_of(min(self.step, self.config.n_steps) - 1)
        data, scene = self.config.data, self.scenes[0]
        n_past = stage.history or data.history
        steps, cams = range(n_past + stage.horizon), context_cameras(scene, data)
        masked = scene.has_segmentation()
        frames = make_frames(
            [scene], [spread_views(cams, data.context_views, 0)], [list(steps[:n_past])], masked=masked
        )
        self.simulator.eval()
        try:
            frames = thinned(frames, data).to(self.device)
            state = self.simulator.encode(frames, on_invalid="drop")
            if stage.horizon:
                later = self.simulator.rollout(state, stage.horizon, self.plan, on_invalid="drop")
                state = concatenate([state, *later])
            cameras = scene.cameras_at(cams[:1], steps).to(self.device)
            predicted = self.simulator.render(state, cameras, plan=self.plan, on_invalid="drop").color
        finally:
            self.simulator.train()
        filmed = scene.images(cams[:1], steps)[:, 0].permute(0, 2, 3, 1)
        return torch.cat([filmed, (predicted.clamp(0, 1) * 255).round().to(torch.uint8).cpu()], 2)

    def save(self) -> Path | None:
        """Writes a checkpoint of this step into the run folder; None where another process does."""
        if not self.processes.is_first:
            return None
        moments = {}
        for name, parameter in self.parameters.items():
            for kind, value in self.optimizer.state[parameter].items():
                moments[f"{kind}.{name}"] = value
        state = {
            "step": self.step,
            "next_sample": self.step,
            "n_skipped": self.n_skipped,
            "n_skipped_in_a_row": self.n_skipped_in_a_row,
            "seconds": self.seconds,
            "parent": self.parent,
            "loss_scale": [self.scale.value, self.scale.n_good],
            "scenes": [scene.name for scene in self.scenes],
        }
        folder = checkpoint.save(
            self.out,
            checkpoint.Checkpoint(
                model=self.simulator.state_dict(),
                ema=self.average,
                optimizer=moments,
                config=describe(self.config, self.simulator.config, self.scenes[0], self.plan_spec),
                state=state,
            ),
            self.config.keep_checkpoints,
        )
        self.parent = checkpoint.digest_of(folder)
        return folder

    def _resume(self) -> None:
        saved = checkpoint.load(self.out)
        check_same_run(self.config, saved.config.get("train", {}), self.out)
        keep_jacobian(self.simulator, saved.config["model"])
        names = [scene.name for scene in self.scenes]
        known = saved.state.get("scenes", names)
        if missing := sorted(set(known) - set(names)):
            raise InputError(
                f"{self.out}: was trained on {len(missing)} scenes that are not given now, such as {missing[0]}; "
                "give the same ones, or more, or use another folder"
            )
        self.same_scenes = known == names
        try:
            self._load(saved)
        except (RuntimeError, KeyError, ValueError) as error:
            reason = str(error).splitlines()[-1].strip()[:200]
            raise InputError(f"{self.out}: its checkpoint does not fit the configuration: {reason}") from None

    def _load(self, saved: checkpoint.Checkpoint) -> None:
        self.simulator.load_state_dict(saved.model)
        if self.average:
            weights = self.simulator.state_dict()
            self.average = {name: checkpoint.laid_out_as(value, saved.ema[name]) for name, value in weights.items()}
        moments = defaultdict(dict)
        for key, value in saved.optimizer.items():
            kind, name = key.split(".", 1)
            moments[name][kind] = value
        for name, parameter in self.parameters.items():
            if name in moments:
                self.optimizer.restore(parameter, moments[name])
        state = saved.state
        self.step, self.n_skipped = state["step"], state.get("n_skipped", 0)
        self.n_skipped_in_a_row = state.get("n_skipped_in_a_row", 0)
        self.seconds, self.parent = state.get("seconds", 0.0), saved.digest
        self.scale = LossScale(*state.get("loss_scale", (self.scale.value, 0)))

    def _update_average(self, gradients: Sequence[Tensor | None]) -> None:
        decay = min(self.config.optimizer.ema_decay, (1 + self.step) / (EMA_WARM_UP + self.step))
        if not self.average:
            return
        with torch.no_grad():
            pairs = zip(self.parameters.items(), gradients, strict=True)
            weights = {name: parameter for (name, parameter), gradient in pairs if gradient is not None}
            weights |= {name: x for name, x in self.buffers.items() if x.is_floating_point()}
            if weights:
                torch._foreach_lerp_([self.average[name] for name in weights], list(weights.values()), 1 - decay)
            for name in self.buffers.keys() - weights.keys():
                self.average[name].copy_(self.buffers[name])


class _Loss(nn.Module):
    """The loss as a module that holds the model, as torch wants it; without a batch a zero with all weights in it."""

    def __init__(self, trainer: Trainer):
        super().__init__()
        self.simulator, self._trainer = trainer.simulator, trainer

    def forward(self, *arguments) -> tuple[Tensor, Tensor]:
        if arguments:
            return self._trainer.loss(*arguments)
        zero = sum(parameter.sum() * 0 for parameter in self.simulator.parameters())
        return zero, zero.detach()


def _start_worker(n_threads: int) -> None:
    """Gives this thread its share of the cores."""
    torch.set_num_threads(n_threads)


def _mean(results: list) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """Means of losses, errors and gradients, added in the order of the samples."""
    if len(results) == 1:
        return results[0]
    losses, errors, gradients = zip(*results, strict=True)
    means = []
    for parts in zip(*gradients, strict=True):
        known = [part for part in parts if part is not None]
        means.append(sum(known[1:], known[0]) / len(results) if known else None)
    return sum(losses) / len(results), sum(errors) / len(results), means


def _psnr(errors: Tensor) -> float:
    return -10 * math.log10(max(1e-10, errors.mean().item())) if bool(errors.isfinite().all()) else math.nan
