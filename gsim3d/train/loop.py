"""The training loop. A step is a function of (weights, configuration, step): a resumed run repeats it bit for bit."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from gsim3d.data import Scene, generator
from gsim3d.dynamics import concatenate
from gsim3d.effects import EffectsSpec, Plan
from gsim3d.errors import HardCaseError, InputError
from gsim3d.perceptual.lpips import LPIPS
from gsim3d.perceptual.weights import load
from gsim3d.simulator import Simulator
from gsim3d.train import checkpoint
from gsim3d.train.config import TrainConfig
from gsim3d.train.losses import image_errors, image_loss, mean_by_step, time_weights
from gsim3d.train.restore import build_simulator, check_device, describe, model_config
from gsim3d.train.samples import Batch, check_scenes, draw_batch
from gsim3d.train.schedule import one_cycle
from gsim3d.train.settings import to_dict
from gsim3d.train.watch import StepWatch, first_not_finite, mean_of_norms, norms_by_module

LOG = "metrics.jsonl"
EMA_WARM_UP = 10  # the average forgets its first values: decay is at most (1 + step) / (10 + step)
# May change between two sittings of one run without changing the curve; so may the number of workers, if there are any.
FREE_SETTINGS = ("checkpoint_every", "keep_checkpoints", "log_every")
# May change as well, so that a run which diverged can go on; the curve is another one from there on.
FREE_OF_OPTIMIZER, FREE_OF_STAGES = ("clip_norm", "max_skipped"), ("learning_rate", "warm_up")


class Trainer:
    """One training run in a folder: weights, optimizer and averaged weights at some step.

    Args:
        config: the run. A folder that already has a checkpoint must have been started with the same one.
        scenes: to train on, in a fixed order.
        out: run folder, made if absent.
        device: "cpu" or "cuda". A run may change it between two sittings; its numbers then change by rounding.
    """

    def __init__(self, config: TrainConfig, scenes: Sequence[Scene], out: str | Path, *, device: str = "cpu"):
        check_device(device)
        self.device = device
        check_scenes(scenes, config.data, config.stages)
        self.config, self.scenes, self.out = config, list(scenes), Path(out)
        self.plan_spec = EffectsSpec.from_dict(config.effects)
        self.simulator = build_simulator(model_config(config), config.seed).to(device)
        self.plan = self.simulator.plan(self.plan_spec)
        _check_history(config, self.plan)
        if config.workers and self.simulator.config.dynamics.norm == "batch":
            raise InputError("workers: must be 0 for a model with batch normalisation, which needs all samples at once")
        self.perceptual = load("lpips_vgg", partial(LPIPS, "vgg")).to(device) if config.loss.perceptual else None
        self.parameters = dict(self.simulator.named_parameters())
        settings = config.optimizer
        self.optimizer = torch.optim.AdamW(
            self.parameters.values(),
            lr=0.0,
            betas=(settings.beta1, settings.beta2),
            eps=settings.eps,
            weight_decay=settings.weight_decay,
        )
        self.average = {k: v.clone() for k, v in self.simulator.state_dict().items()} if settings.ema_decay else {}
        self.step = self.n_skipped = self.n_skipped_in_a_row = 0
        self.seconds = 0.0
        self.parent = None
        if checkpoint.exists(self.out):
            self._resume()
        self._cut_log()

    def run(self, *, until: int | None = None, progress: bool = True) -> None:
        """Trains to the end of the configuration, or to optimizer step ``until``, and saves there.

        Raises:
            HardCaseError: ``optimizer.max_skipped`` steps in a row were skipped; the message says what to do.
        """
        until = self.config.n_steps if until is None else min(until, self.config.n_steps)
        self.out.mkdir(parents=True, exist_ok=True)
        self.simulator.train()
        bar = tqdm(total=until, initial=self.step, desc="training", unit="step", disable=not progress)
        with bar, deterministic(), open(self.out / LOG, "a") as log:
            while self.step < until:
                start = time.perf_counter()
                entry = self.train_step()
                self.seconds += time.perf_counter() - start
                if entry["step"] % self.config.log_every == 0 or "skipped" in entry or self.step == self.config.n_steps:
                    log.write(json.dumps({**entry, "seconds": round(self.seconds, 2)}) + "\n")
                    log.flush()
                self._stop_if_diverged(entry)
                bar.set_postfix_str(_postfix(entry), refresh=False)
                bar.update()
                if self.step % self.config.checkpoint_every == 0 or self.step == until:
                    self.save()

    def train_step(self) -> dict:
        """One optimizer step; what to log of it.

        Where loss or gradient is not finite, or a number cannot be used, the step is skipped: weights, moments, averages
        and statistics stay as they are.
        """
        stage, place = self.config.stage_of(self.step)
        rate = one_cycle(place, stage.steps, stage.learning_rate, stage.warm_up)
        groups = [[sample] for sample in range(stage.batch)] if self.config.workers else [list(range(stage.batch))]
        statistics = [(buffer, buffer.clone()) for buffer in self.simulator.buffers()]
        entry = {"step": self.step, "loss": math.nan, "learning_rate": rate, "grad_norm": math.nan}
        n_context = stage.history or self.config.data.history
        errors = torch.full((n_context + stage.horizon,), math.nan)
        try:
            results = self._map(self._gradients, groups)
            loss, errors, gradients = _mean([result[:3] for result in results])
            problem = self._look_at(entry, loss, gradients, [watch for *_, watch in results])
        except HardCaseError as error:
            problem = str(error)
        if problem is None:
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            self.optimizer.step()
            self._update_average()
            self.n_skipped_in_a_row = 0
        else:
            with torch.no_grad():
                for buffer, before in statistics:
                    buffer.copy_(before)
            self.n_skipped += 1
            self.n_skipped_in_a_row += 1
            entry["skipped"] = problem
        entry["past_psnr"] = _psnr(errors[:n_context])
        if stage.horizon:
            entry["future_psnr"] = _psnr(errors[n_context:])
        self.step += 1
        return {name: _plain(value) for name, value in entry.items()}

    def _look_at(
        self, entry: dict, loss: Tensor, gradients: list[Tensor | None], watches: list[StepWatch]
    ) -> str | None:
        """Hands the gradients to the optimizer, clipped, and fills in ``entry``; why they cannot be used, or None."""
        named = dict(zip(self.parameters, gradients, strict=True))
        for name, parameter in self.parameters.items():
            parameter.grad = named[name]
        is_logged = self.step % self.config.log_every == 0
        if is_logged:
            entry["grad_norm_by_module"] = norms_by_module(named)
        entry["loss"] = loss.item()
        entry["grad_norm"] = torch.nn.utils.clip_grad_norm_(
            self.parameters.values(), self.config.optimizer.clip_norm or math.inf
        ).item()
        if is_logged and (by_step := mean_of_norms([watch.norms() for watch in watches])):
            entry["grad_norm_by_step"] = by_step
        if total := sum(watch.report.total for watch in watches):
            entry["unusable_rows"] = total
        for watch in watches:
            watch.report.check()
        if not math.isfinite(entry["loss"]):
            return "the loss is not finite"
        if not math.isfinite(entry["grad_norm"]):
            return f"the gradient is not finite, first that of {first_not_finite(named.items())}"
        return None

    def _stop_if_diverged(self, entry: dict) -> None:
        n, limit = self.n_skipped_in_a_row, self.config.optimizer.max_skipped
        if n < limit:
            return
        found = checkpoint.exists(self.out)
        good = f"its last checkpoint in {self.out}" if found else "its start: no checkpoint was written yet"
        raise HardCaseError(
            f"training: {n} steps in a row were skipped up to step {entry['step']}, the last because {entry['skipped']}; "
            f"lower stages.learning_rate or optimizer.clip_norm and train again: the run goes on from {good}",
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
        stage, _ = self.config.stage_of(self.step)
        watch = StepWatch()
        batch = draw_batch(self.scenes, self.config.data, stage, self.config.seed, self.step, samples)
        loss, errors = self.loss(batch.to(self.device), samples[0], watch)
        gradients = torch.autograd.grad(loss, list(self.parameters.values()), allow_unused=True)
        return loss.detach(), errors, gradients, watch

    def loss(self, batch: Batch, sample: int = 0, watch: StepWatch | None = None) -> tuple[Tensor, Tensor]:
        """The loss of a batch, and the unweighted mean squared error of each step; ``sample`` numbers the randomness."""
        watch = watch or StepWatch()
        loss_config, targets = self.config.loss, batch.targets
        rng = generator(self.config.seed, self.step, sample, "dynamics")
        noise = torch.Generator().manual_seed(int(rng.integers(2**63)))
        particles = self.simulator.encode(batch.context, report=watch.report)
        if batch.n_future:
            steps = self.simulator.rollout(
                particles, batch.n_future, self.plan, generator=noise, report=watch.report
            )
            watch.follow(steps)
            particles = concatenate([particles, *steps])
        images = self.simulator.render(particles, targets.cameras, plan=self.plan, report=watch.report).color
        truth = targets.images.permute(0, 2, 3, 1)
        weighted = loss_config.body_weight and targets.dynamic is not None
        weight = 1 + loss_config.body_weight * targets.dynamic if weighted else None
        if targets.valid is not None:
            weight = targets.valid.float() if weight is None else weight * targets.valid
        weights = time_weights(
            batch.n_context, batch.n_future, balance=loss_config.balance, discount=loss_config.discount
        )
        step = batch.target_step()
        wrong = image_errors(images, truth, weight)
        if self.perceptual is not None:
            seen = images if targets.valid is None else torch.where(targets.valid[..., None], images, truth)
            distances = self.perceptual(seen.permute(0, 3, 1, 2), targets.images)
            wrong = wrong + loss_config.perceptual * distances
        loss = image_loss(wrong, step, weights)
        with torch.no_grad():
            errors = mean_by_step(image_errors(images, truth, targets.valid), step, batch.n_context + batch.n_future)
        return loss, errors

    def save(self) -> Path:
        """Writes a checkpoint of this step into the run folder."""
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
        before, now = dict(saved.config.get("train", {})), to_dict(self.config)
        before, now = _fixed_settings(before), _fixed_settings(now)
        for name in now:
            if name not in FREE_SETTINGS and before.get(name) != now[name]:
                raise InputError(f"{self.out}: was started with another {name!r}; use the same or another folder")
        self.simulator.load_state_dict(saved.model)
        if self.average:
            self.average = {name: value.to(self.device) for name, value in saved.ema.items()}
        for key, value in saved.optimizer.items():
            kind, name = key.split(".", 1)
            if name in self.parameters:
                # AdamW counts its steps on the host.
                self.optimizer.state[self.parameters[name]][kind] = value if kind == "step" else value.to(self.device)
        self.step, self.n_skipped = saved.state["step"], saved.state["n_skipped"]
        self.n_skipped_in_a_row = saved.state.get("n_skipped_in_a_row", 0)
        self.seconds, self.parent = saved.state["seconds"], saved.digest

    def _cut_log(self) -> None:
        """Drops what was logged after the last checkpoint, if there is one: those steps will be repeated."""
        file = self.out / LOG
        if file.exists():
            lines = file.read_text().splitlines()
            kept = [line for line in lines if _step_of(line) < self.step]
            if kept != lines:
                part = file.with_name(f".{file.name}.part")
                part.write_text("".join(line + "\n" for line in kept))
                os.replace(part, file)

    def _update_average(self) -> None:
        decay = min(self.config.optimizer.ema_decay, (1 + self.step) / (EMA_WARM_UP + self.step))
        with torch.no_grad():
            for name, value in self.simulator.state_dict().items():
                if name in self.average:
                    if value.is_floating_point():
                        self.average[name].lerp_(value, 1 - decay)
                    else:
                        self.average[name].copy_(value)


def _fixed_settings(settings: dict) -> dict:
    """Of a run's settings those that must stay, as far as parts of them may change."""
    fixed = {**settings, "workers": bool(settings.get("workers"))}
    for name, free in (("optimizer", FREE_OF_OPTIMIZER), ("stages", FREE_OF_STAGES)):
        parts = settings.get(name) or []
        kept = [{k: v for k, v in part.items() if k not in free} for part in ([parts] if name == "optimizer" else parts)]
        fixed[name] = kept
    return fixed


@contextmanager
def deterministic() -> Iterator[None]:
    """Within it torch uses deterministic algorithms only."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory
    cudnn = torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # costs time and changes no result of a correct op
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
        torch.utils.deterministic.fill_uninitialized_memory = fill
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = cudnn


def _start_worker(n_threads: int) -> None:
    """Gives this thread its share of the cores."""
    torch.set_num_threads(n_threads)


def _mean(results: list) -> tuple[Tensor, Tensor, list[Tensor | None]]:
    """Means of losses, errors and gradients, added in the order of the samples."""
    losses, errors, gradients = zip(*results, strict=True)
    means = []
    for parts in zip(*gradients, strict=True):
        known = [part for part in parts if part is not None]
        means.append(sum(known[1:], known[0]) / len(results) if known else None)
    return sum(losses) / len(results), sum(errors) / len(results), means


def _check_history(config: TrainConfig, plan: Plan) -> None:
    for history in {config.data.history, *(stage.history for stage in config.stages if stage.horizon)}:
        if history > plan.history:
            raise InputError(f"data.history: {history} steps, but this model sees up to {plan.history}")


def _psnr(errors: Tensor) -> float:
    return -10 * math.log10(max(1e-10, errors.mean().item())) if bool(errors.isfinite().all()) else math.nan


def _plain(value):
    """JSON has no NaN: what is not finite is logged as text."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _step_of(line: str) -> float:
    try:
        return json.loads(line)["step"]
    except (ValueError, KeyError, TypeError):
        return math.inf  # the last line of a killed process


def _postfix(entry: dict) -> str:
    values = {name: entry.get(f"{name}_psnr") for name in ("past", "future")}
    return ", ".join(f"{name} {value:.1f} dB" for name, value in values.items() if isinstance(value, float))
