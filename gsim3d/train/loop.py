"""The training loop. A step depends only on (weights, configuration, step), so a resumed run has equal bits."""

import dataclasses
import math
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from gsim3d.compat.depth_weights import load_depth_weights
from gsim3d.data import Scene, generator
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError, NumericalError, RunStopped
from gsim3d.evaluate.perceptual.lpips import LPIPS
from gsim3d.evaluate.perceptual.weights import load
from gsim3d.io import checkpoint
from gsim3d.io.locks import only_one_writer
from gsim3d.pretrained.loading import check_device
from gsim3d.state import concatenate
from gsim3d.train.captured import CapturedLoss, Prepared
from gsim3d.train.config import PhaseConfig, TrainConfig, check_same_run, check_settings
from gsim3d.train.features import FeatureCache
from gsim3d.train.gradients import (
    Seen,
    StepWatch,
    in_segments,
    mean_of_norms,
    mean_of_samples,
    norms_by_module,
    recomputing,
)
from gsim3d.train.left_out import draw_left_out, images_per_cloud, with_views
from gsim3d.train.log import Log, Sample, draw_sample, memory_gib, plain, profiler, progress_note, sample_video
from gsim3d.train.losses import time_weights, training_loss
from gsim3d.train.optimizer import FIRST_SCALE, LossScale, Optimizer, deterministic, one_cycle, update_average
from gsim3d.train.processes import Processes
from gsim3d.train.restore import build_simulator, describe, keep_jacobian, model_config
from gsim3d.train.samples import Batch, BatchReader, check_scenes, displaced, draw_batch, history_at, unfreeze
from gsim3d.train.stopping import noted_signals

EMA_WARM_UP = 10  # the decay of the average is at most (1 + step) / (EMA_WARM_UP + step)


class Trainer:
    """A training run in a folder; resumes from its last checkpoint if there is one.

    Args:
        config: configuration; must equal that of a run to resume.
        scenes: training scenes, in a fixed order. A resumed run may have more scenes, but not fewer.
        out: run folder, created if absent.
        device: "cpu" or "cuda". If it changes on resume, results change by rounding.
        processes: processes that train together, see :func:`gsim3d.train.processes.joined`; each has its own Trainer,
            and the first one writes. Their number changes results by rounding, and the random draws of drop path and
            shuffled curves. Batch normalisation is synchronised.

    Attributes:
        step: number of completed optimizer steps.
        same_scenes: False if scenes were added on resume, which changes the results.
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
        check_scenes(scenes, config.data, config.phases)
        self.config, self.scenes, self.out = config, list(scenes), Path(out)
        self.effects = EffectsSpec.from_dict(config.effects)
        self.simulator = build_simulator(model_config(config), config.seed).to(device)
        if config.pretrained_depth and not checkpoint.exists(self.out):
            load_depth_weights(self.simulator.encoder, config.pretrained_depth)
        self.plan = self.simulator.plan(self.effects)
        if not self.effects.outputs.rgb:
            raise InputError("effects: outputs.rgb is off, but the loss compares colours; leave it on")
        check_settings(config, self.simulator.config.dynamics, self.plan, self.processes.count)
        if self.effects.dynamics.actions and not any(scene.has_actions() for scene in scenes):
            raise InputError("effects: dynamics.actions is on, but no scene has actions (actions.npz); leave it out")
        perceptual = self._perceptual() if config.loss.perceptual else None
        self.loss_of_images = partial(training_loss, config.loss, perceptual)
        self.parameters = dict(self.simulator.named_parameters())
        self.buffers = dict(self.simulator.named_buffers())
        self.optimizer = Optimizer(self.parameters, config.optimizer)
        averaged = self.simulator.state_dict() if config.optimizer.ema_decay else {}
        self.average = {name: value.clone() for name, value in averaged.items()}
        self.scale = LossScale(FIRST_SCALE if config.precision.scales_loss else 1.0)
        self.step = self.n_skipped = self.n_skipped_in_a_row = 0
        self.seconds = 0.0
        self.parent: str | None = None
        self.same_scenes = True
        self._signals: list[int] = []
        self._stop: tuple[str, int] | None = None  # why, and the exit code
        self._read = BatchReader(lambda *given: self._draw(*given), config.n_steps)
        if checkpoint.exists(self.out):
            self._resume()
        self.log = Log(self.out, writes=self.processes.is_first)
        self.log.cut(self.step)
        self.processes.check_agreement(
            **{"CONFIG": self.config, "--out": (self.step, self.parent), "--data": [s.name for s in self.scenes]}
        )
        frozen = self.simulator.encoder.has_frozen_backbone
        self.features = FeatureCache(self.simulator.encoder, device) if frozen else None
        self.captured = self._capture() if config.captured and device == "cuda" else None

    def _perceptual(self) -> Callable[[Tensor, Tensor], Tensor]:
        """LPIPS in its precision."""
        network = load("lpips_vgg", partial(LPIPS, "vgg")).to(self.device)

        def distance(images: Tensor, truth: Tensor) -> Tensor:
            with self.config.precision.of("perceptual", self.device):
                return network(images, truth)

        return distance

    def _capture(self) -> CapturedLoss:
        precision, loss = partial(self.config.precision.of, device=self.device), self.config.loss
        parts = self.config.recompute, self.config.data.leave_one_out, loss.image_gain
        return CapturedLoss(self.simulator, self.plan, self.loss_of_images, precision, *parts)

    # ---- the loop ----

    def run(
        self,
        *,
        until: int | None = None,
        end: float = math.inf,
        progress: bool = True,
        tensorboard: bool = False,
        wandb: bool = False,
        watch: Callable[[Sample, int], None] | None = None,
        watched: Scene | None = None,
        profile: bool = False,
    ) -> None:
        """Trains to the end of the configuration, or to optimizer step ``until``, and saves a checkpoint.

        Args:
            until: optimizer step to stop after; None: the last one.
            end: time of time.monotonic() at which to save and stop; for a single process.
            progress: show a progress bar.
            tensorboard: also log for TensorBoard, with a sample video at each checkpoint.
            wandb: also log for Weights & Biases.
            watch: called by the first process with a sample and the step, before the first step and at each checkpoint.
            watched: scene of that sample. Default: the first training scene.
            profile: write a trace of two steps.

        Raises:
            NumericalError: ``optimizer.max_skipped`` consecutive steps were skipped.
            RunStopped: saved and stopped before ``until``, because of a signal or a lost launcher.
        """
        until = self.config.n_steps if until is None else min(until, self.config.n_steps)
        self.out.mkdir(parents=True, exist_ok=True)
        self.simulator.train()
        self.processes.check_same(weights=self.parameters.values())
        shows = progress and self.processes.is_first
        bar = tqdm(total=until, initial=self.step, desc="training", unit="step", disable=None if shows else True)
        tracer = profiler(self.out, self.processes.rank, until - self.step) if profile else nullcontext()
        lock = only_one_writer(self.out) if self.processes.is_first else nullcontext()
        config = describe(self.config, self.simulator.config, self.scenes[0], self.effects) if wandb else None
        log, signals = self.log.opened(tensorboard=tensorboard, wandb=config), noted_signals()
        watch = watch if self.processes.is_first else None
        with lock, bar, deterministic(), log, tracer, signals as self._signals:
            stops = self.step >= until
            if watch is not None:
                watch(self.draw_sample(watched), self.step)
            while not stops:
                start = time.perf_counter()
                entry = self.train_step()
                spent = time.perf_counter() - start
                self.seconds += spent
                if self.processes.count == 1:  # otherwise agreed on within the step
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
                        self.log.board.video(sample_video(self.simulator, self.plan, self.draw_sample()), self.step)
                    if watch is not None:
                        watch(self.draw_sample(watched), self.step)
        self.processes.check_same(weights=self.parameters.values())  # also waits until the first process has saved
        if self._stop is not None and self.step < until:
            why, code = self._stop
            saved = f"step {self.step} of {self.config.n_steps} is saved in {self.out}"
            raise RunStopped(f"{why}: {saved}; run the same command to resume", code)

    def train_step(self) -> dict:
        """Performs one optimizer step; returns its log entry.

        The step is skipped if loss or gradient is not finite, or a number is invalid: weights, moments, averages and
        running statistics stay unchanged.
        """
        phase, number = self.config.phase_of(self.step)
        rate = self.learning_rate(phase, number)
        statistics = [(buffer, buffer.clone()) for buffer in self.buffers.values()]
        entry = {"step": self.step, "loss": math.nan, "learning_rate": rate, "grad_norm": math.nan}
        n_past = history_at(self.config.data, phase, self.config.seed, self.step)
        errors = torch.full((n_past + phase.horizon,), math.nan)
        try:
            loss, errors, gradients, seen = self._whole_batch(phase.batch)
            norm = torch.nn.utils.get_total_norm([gradient for gradient in gradients if gradient is not None])
            problem = self._check(entry, loss, gradients, norm, seen)
        except NumericalError as error:
            problem = str(error)
        if problem is None:
            self.optimizer.update(gradients, norm, rate, phase.encoder_rate)
            if self.average:
                decay = min(self.config.optimizer.ema_decay, (1 + self.step) / (EMA_WARM_UP + self.step))
                update_average(self.average, self.parameters, self.buffers, gradients, decay)
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
        entry["past_psnr"] = _psnr(errors[:n_past])
        if phase.horizon:
            entry["future_psnr"] = _psnr(errors[n_past:])
        self.step += 1
        return {name: plain(value) for name, value in entry.items()}

    def learning_rate(self, phase: PhaseConfig, number: int) -> float:
        """Returns the learning rate of step ``number`` of a phase."""
        return one_cycle(number, phase.steps, phase.learning_rate, phase.warm_up)

    def _check(self, entry: dict, loss: float, gradients: Sequence, norm: Tensor, seen: list[Seen]) -> str | None:
        """Fills in ``entry``; returns the reason why gradients are invalid, None if they are valid."""
        named = dict(zip(self.parameters, gradients, strict=True))
        if self._is_logged:
            entry["grad_norm_by_module"] = norms_by_module(named)
        entry["loss"] = loss
        entry["grad_norm"] = norm.item()
        if self._is_logged and (by_step := mean_of_norms([share.norms for share in seen])):
            entry["grad_norm_by_step"] = by_step
        entry["particles"] = sum(share.n_particles for share in seen) / max(1, sum(share.n_clouds for share in seen))
        if total := sum(share.n_unusable for share in seen):
            entry["unusable_particles"] = total
        if errors := [share.error for share in seen if share.error]:
            return errors[0]
        if not math.isfinite(entry["loss"]):
            return "the loss is not finite"
        if not math.isfinite(entry["grad_norm"]):
            return f"the gradient is not finite, first that of {checkpoint.first_not_finite(named)}"
        return None

    @property
    def _is_logged(self) -> bool:
        return self.step % self.config.log_every == 0

    def _reason_to_stop(self) -> tuple[str, int] | None:
        """Returns the reason to save and stop, with the exit code; None to continue."""
        if self._signals:
            return signal.Signals(self._signals[0]).name, 128 + self._signals[0]
        return (self.processes.lost, 2) if self.processes.lost else None

    def _stop_if_diverged(self, entry: dict) -> None:
        if self.n_skipped_in_a_row < self.config.optimizer.max_skipped:
            return
        found = checkpoint.exists(self.out)
        good = f"its last checkpoint in {self.out}" if found else "its start: no checkpoint was written yet"
        raise NumericalError(
            f"training: {self.n_skipped_in_a_row} consecutive steps were skipped up to step {entry['step']}, "
            f"the last because {entry['skipped']}; lower phases.learning_rate or optimizer.clip_norm and train again: "
            f"the run resumes from {good}",
            step=entry["step"],
        )

    # ---- gradients of a batch, computed here, by threads, by processes or from a graph ----

    def _whole_batch(self, batch: int) -> tuple[float, Tensor, Sequence[Tensor | None], list[Seen]]:
        """Returns loss, errors by step and gradients of the whole batch, and statistics of each share of it."""
        scale, samples = self.scale.value, self.processes.share(batch)
        norms_scale = scale if self._is_logged else None
        if self.processes.count > 1:
            loss, errors, gradients, seen = self._of_all_processes(samples, batch, norms_scale)
        else:
            groups = [[sample] for sample in samples] if self.config.workers else [samples]
            results = self._map(self._gradients, groups)
            loss, errors, gradients = mean_of_samples([result[:3] for result in results])
            loss, seen = loss.item(), [watch.seen(norms_scale) for *_, watch in results]
        if scale != 1:
            gradients = [None if gradient is None else gradient / scale for gradient in gradients]
        return loss, errors, gradients, seen

    def _gradients(
        self, samples: list[int], watch: StepWatch | None = None, factor: float = 1.0
    ) -> tuple[Tensor, Tensor, Sequence[Tensor | None], StepWatch]:
        """Returns loss, errors by step, gradients times ``factor`` and loss scale (a graph reuses them), statistics."""
        watch, factor = watch or StepWatch(), factor * self.scale.value
        if self.captured is not None:
            prepared = self._prepared(samples)
            watch.n_particles, watch.n_clouds = sum(prepared.counts), len(prepared.counts)
            found = self.captured(prepared, self.step_weights(prepared.batch) * factor, watch.report)
            return found.loss / factor, found.errors, found.parameters, watch
        loss, errors = self.loss(self._batch(samples), samples[0], watch)
        gradients = torch.autograd.grad(loss * factor, list(self.parameters.values()), allow_unused=True)
        return loss.detach(), errors, gradients, watch

    def _prepared(self, samples: list[int]) -> Prepared:
        return self.captured.prepare(self._batch(samples))

    def _map(self, f: Callable, groups: list) -> list:
        """Maps ``f`` over groups, in parallel threads if there are workers, each with a share of the cores."""
        n_workers, n_threads = min(self.config.workers, len(groups), torch.get_num_threads()), torch.get_num_threads()
        if n_workers < 2:
            return [f(group) for group in groups]
        try:
            with ThreadPoolExecutor(n_workers, initializer=lambda: torch.set_num_threads(n_threads // n_workers)) as p:
                return list(p.map(f, groups))
        finally:
            torch.set_num_threads(n_threads)

    def _of_all_processes(self, samples: list[int], batch: int, norms_scale: float | None) -> tuple:
        """Returns loss, errors, gradients and statistics over all processes; this one computes ``samples``."""
        # A process that raises within a step would block the others, so invalid numbers are dropped and reported later.
        drops = self.captured is None and self.simulator.config.stability.on_invalid == "raise"
        watch, share, count = StepWatch(strict=drops), len(samples) / batch, self.processes.count
        try:  # batch norms sum gradients over processes, so each loss is weighted before the backward pass
            loss, errors, gradients, _ = self._gradients(samples, watch, share * count)
            seen = watch.seen(norms_scale)
        except NumericalError as error:
            loss, errors, gradients, seen = *torch.full((2,), math.nan), (), Seen(error=str(error))
        known = [gradient is not None for gradient in gradients]
        gathered = self.processes.gather((loss.item(), errors.cpu(), share, seen, known, self._reason_to_stop()))
        losses, errors, shares, seen, known, reasons = zip(*gathered, strict=True)
        self._stop = next(filter(None, reasons), None)
        for rank, of_process in enumerate(seen):
            if of_process.error:
                raise NumericalError(f"process {rank}: {of_process.error}")
        loss = sum(loss * share for loss, share in zip(losses, shares, strict=True))
        errors = sum(values * share for values, share in zip(errors, shares, strict=True))
        gradients = [  # parameters used in other processes only have gradient 0 here
            torch.zeros_like(parameter) if gradient is None and any(elsewhere) else gradient
            for parameter, gradient, elsewhere in zip(self.parameters.values(), gradients, zip(*known, strict=True))
        ]
        return loss, errors, self.processes.add(gradients, 1 / count), list(seen)

    # ---- the loss of a batch ----

    def _batch(self, samples: list[int]) -> Batch:
        batch = self._read(self.step, samples)
        if self.features is not None:
            with self.config.precision.of("encoder", self.device):
                batch = dataclasses.replace(batch, context=self.features(batch.context))
        return batch.to(self.device)

    def _draw(self, step: int, samples: Sequence[int]) -> Batch:
        phase, _ = self.config.phase_of(step)
        batch = draw_batch(self.scenes, self.config.data, phase, self.config.seed, step, samples)
        return batch.map(Tensor.pin_memory) if self.device == "cuda" else batch

    def loss(self, batch: Batch, sample: int = 0, watch: StepWatch | None = None) -> tuple[Tensor, Tensor]:
        """Computes the loss of a batch and the unweighted mean squared error of each step; ``sample`` seeds noise."""
        images = self._images(batch, sample, watch or StepWatch())
        return self.loss_of_images(images, batch.targets, self.step_weights(batch))

    def step_weights(self, batch: Batch) -> Tensor:
        """Returns the weight [S] of each step of a batch."""
        settings = self.config.loss
        weights = time_weights(batch.n_context, batch.n_future, balance=settings.balance, discount=settings.discount)
        return weights.to(self.device)

    def _images(self, batch: Batch, sample: int, watch: StepWatch) -> Tensor:
        """Predicts the images of the target cameras of a batch, each part of the model in its precision."""
        simulator, precision = self.simulator, self.config.precision
        again = recomputing(self.config.recompute, simulator)
        options = {"report": watch.report, "on_invalid": "drop" if watch.strict else None}
        rng = generator(self.config.seed, self.step, sample, "dynamics")
        noise = torch.Generator().manual_seed(int(rng.integers(2**63)))

        with precision.of("encoder", self.device):
            particles = again("encoder")(lambda context: simulator.encode(context, **options))(batch.context)
        if self.config.data.leave_one_out:
            particles = with_views(particles, batch.context)
        watch.n_particles, watch.n_clouds = particles.n_rows, particles.n_clouds
        if batch.n_future:
            if self.config.data.unfrozen_background:
                rng = generator(self.config.seed, self.step, sample, "thawed")  # name of older versions, kept for bits
                particles = unfreeze(particles, self.config.data.unfrozen_background, self.effects, rng)
            with precision.of("dynamics", self.device):
                begin = simulator._prepare(particles, self.plan)
                begin = displaced(begin, batch.noise, simulator.config.dynamics.grid_size)
                given = {"plan": self.plan, "generator": noise, "wrap": again("steps", noise), **options}
                sizes = batch.n_future, batch.cut, self.plan.history
                steps = sum(in_segments(partial(simulator.rollout, **given), begin, *sizes), [])
            if self._is_logged:
                watch.follow(steps)
            particles = concatenate([particles, *steps])
        draw = {"plan": self.plan, **options}
        with precision.of("renderer", self.device):
            render = again("images")(lambda p, cameras, valid: simulator.render(p, cameras, active=valid, **draw).color)
            if self.config.data.leave_one_out:
                images = draw_left_out(render, particles, batch.targets, images_per_cloud(batch.context))
            else:
                images = render(particles, batch.targets.cameras, batch.targets.valid)
        watch.report.close()  # recomputation in the backward pass must not count again
        return images

    def draw_sample(self, scene: Scene | None = None) -> Sample:
        """Predicts the first window of ``scene`` (default: the first scene) with the current weights."""
        phase, _ = self.config.phase_of(max(0, min(self.step, self.config.n_steps) - 1))
        return draw_sample(self.simulator, self.plan, scene or self.scenes[0], self.config.data, phase, self.device)

    # ---- checkpoints ----

    def save(self) -> Path | None:
        """Writes a checkpoint and returns its folder; None in all processes but the first."""
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
        config = describe(self.config, self.simulator.config, self.scenes[0], self.effects)
        saved = checkpoint.Checkpoint(self.simulator.state_dict(), config, state, self.average, moments)
        folder = checkpoint.save(self.out, saved, self.config.keep_checkpoints)
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
                f"{self.out}: was trained on {len(missing)} scenes that are missing now, such as {missing[0]}; "
                "give the same scenes or more, or use another folder"
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


def _psnr(errors: Tensor) -> float:
    return -10 * math.log10(max(1e-10, errors.mean().item())) if bool(errors.isfinite().all()) else math.nan
