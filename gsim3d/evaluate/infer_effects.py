"""Search for the cheapest EffectsSpec without loss of quality on a scene (``gsim3d effects infer``)."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from statistics import fmean

from gsim3d.data import Scene
from gsim3d.data.recording import evenly_spaced
from gsim3d.effects.plan import make_plan
from gsim3d.effects.spec import EffectsSpec
from gsim3d.evaluate.protocol import default_views, encode_steps, horizon, render_steps
from gsim3d.io.terminal import in_columns
from gsim3d.presets import ModelConfig
from gsim3d.state import concatenate, last_steps
from gsim3d.train.restore import Restored

WINDOWS, STEPS = 3, 4  # windows over the video, and predicted steps in each
ROUNDS = 3  # timed repetitions; the fastest counts

Settings = dict[str, list[tuple[str, EffectsSpec]]]  # effect -> (setting, spec with it)
Measured = tuple[float, float]  # PSNR in dB, seconds per step


@dataclass(frozen=True)
class Proposal:
    """Result of :func:`infer`."""

    spec: EffectsSpec  #: the smallest spec within the tolerance
    measured: Measured  #: PSNR in dB and seconds per step with ``spec``
    before: Measured  #: PSNR in dB and seconds per step with the checkpoint's spec
    constant_psnr: float  #: PSNR in dB of the constant baseline, the last encoded particles
    n_cameras: int  #: number of target cameras
    table: list[tuple[str, ...]]  #: (effect, setting, gain in dB, cost in ms, note) of every setting

    def __str__(self) -> str:
        (psnr, seconds), (now, faster) = self.before, self.measured
        table = in_columns([("effect", "setting", "worth dB", "costs ms", ""), *self.table])
        return (
            f"{psnr:.2f} dB with the checkpoint's effects, {self.constant_psnr:.2f} dB with constant particles; "
            f"{1e3 * seconds:.1f} ms per step with images of {self.n_cameras} cameras\n\n{table}\n\n"
            f"proposed: {now:.2f} dB ({now - psnr:+.3f}), {seconds / faster:.2f} times as fast"
        )


def infer(restored: Restored, scene: Scene, tolerance: float, progress: Callable) -> Proposal:
    """Finds the smallest spec that loses at most ``tolerance`` dB on ``scene``. ``progress``: function number of
    settings -> context manager of a progress bar."""
    base = restored.plan.spec
    settings = smaller_settings(base, restored.simulator.config)
    with progress(2 + sum(map(len, settings.values()))) as bar:
        trial = Trial(restored, scene, bar)
        before = trial(base)
        table, spec, measured = propose(base, settings, trial, before, tolerance)
    return Proposal(spec, measured, before, trial.constant_psnr(), len(trial.cams), table)


def smaller_settings(base: EffectsSpec, model: ModelConfig) -> Settings:
    """Returns every setting smaller than that of ``base``, per effect, in ascending order."""
    plan = make_plan(base, model)
    history = [2**bits for bits in range(model.dynamics.history_bits + 1) if 2**bits < plan.history]
    changing = {"all": ("none", "dynamic"), "none": ()}.get(base.appearance.changing, ("none",))
    dynamics_settings = {
        "history": [(f"{n} step{'s' * (n > 1)}", {"history": n}) for n in history],
        "background": [("masked out", {"background": "masked_out"})] if "background" in plan.on else [],
    }
    appearance_settings = {
        "view_dependent": [(f"degree {d}", {"view_dependent": d}) for d in range(plan.sh_degree)],
        "changing": [(which, {"changing": which}) for which in changing],
        "opacity_changes": [("off", {"opacity_changes": False})] if "opacity_changes" in plan.on else [],
    }
    return {
        effect: [(name, replace(base, **{group: replace(getattr(base, group), **change)})) for name, change in settings]
        for group, effects in (("dynamics", dynamics_settings), ("appearance", appearance_settings))
        for effect, settings in effects.items()
        if settings
    }


def propose(
    base: EffectsSpec, settings: Settings, trial: Callable[[EffectsSpec], Measured], before: Measured, tolerance: float
) -> tuple[list[tuple[str, ...]], EffectsSpec, Measured]:
    """Chooses for each effect the smallest setting that is as good and as fast as ``base``, then combines them.

    While the combination loses more than ``tolerance`` dB or is slower than ``base``, the effect with the largest loss
    or the smallest speed-up is restored. Returns a table of all settings, the chosen spec, and its measurement.

    Args:
        trial: measures a spec.
        before: measurement of ``base``.
    """
    psnr, seconds = before
    table, chosen, lost, saved, put_back, known = [], {}, {}, {}, {}, {base: before}
    for effect, specs in settings.items():
        for name, spec in specs:
            now, duration = known[spec] = trial(spec)
            fits = psnr - now <= tolerance
            if effect not in chosen and fits and duration <= seconds:
                chosen[effect], lost[effect], saved[effect] = spec, psnr - now, seconds - duration
            table.append((effect, name, psnr - now, seconds - duration, chosen.get(effect) is spec, fits))
    while True:
        spec = combined(base, chosen.values())
        now, duration = known[spec] if spec in known else trial(spec)
        if psnr - now > tolerance:
            back, why = max(chosen, key=lost.get), "too much with the others"
        elif duration > seconds:
            back, why = min(chosen, key=saved.get), "slower with the others"
        else:
            break
        del chosen[back]
        put_back[back] = why
    rows = []
    for effect, name, worth, cost, picked, fits in table:
        note = put_back.get(effect, "proposed") if picked else "slower" if fits and cost < 0 else ""
        rows.append((effect, name, f"{worth:+.3f}", f"{1e3 * cost:+.1f}", note))
    return rows, spec, (now, duration)


def combined(base: EffectsSpec, specs: Iterable[EffectsSpec]) -> EffectsSpec:
    """Returns ``base`` with all settings in which one of ``specs`` differs from it."""
    spec = base
    for other in specs:
        for group in (field.name for field in fields(base)):
            mine, theirs = getattr(base, group), getattr(other, group)
            names = (field.name for field in fields(mine))
            changed = {name: value for name in names if (value := getattr(theirs, name)) != getattr(mine, name)}
            spec = replace(spec, **{group: replace(getattr(spec, group), **changed)})
    return spec


class Trial:
    """Measures specs: PSNR of short predictions, and seconds per step with images; each advances ``bar``."""

    def __init__(self, restored: Restored, scene: Scene, bar):
        self.restored, self.scene, self.bar, n_encoded = restored, scene, bar, restored.data.history
        self.n_steps = min(STEPS, horizon(scene, n_encoded, None))
        context, self.cams = default_views(restored, scene)
        starts = evenly_spaced(scene.n_steps - n_encoded - self.n_steps + 1, WINDOWS)
        self.first = [start + n_encoded for start in starts]  # predicted steps of the video
        self.states = [encode_steps(restored, scene, context, start) for start in starts]
        videos = [scene.images(list(self.cams), range(first, first + self.n_steps)) for first in self.first]
        self.videos = [video.permute(0, 1, 3, 4, 2).to(restored.device).float() / 255 for video in videos]

    def __call__(self, spec: EffectsSpec) -> Measured:
        restored, times = replace(self.restored, plan=self.restored.simulator.plan(spec)), []
        predict, n_steps = restored.simulator.predict, self.n_steps
        for _ in range(ROUNDS):
            start = time.perf_counter()
            psnr = self._psnr(restored, lambda state: predict(state, n_steps, restored.plan).steps)
            times.append(time.perf_counter() - start)
        self.bar.total = max(self.bar.total, self.bar.n + 1)  # the number of combinations is not known in advance
        self.bar.update()
        return psnr, min(times) / self.n_steps / len(self.videos)

    def constant_psnr(self) -> float:
        """Returns the PSNR in dB of the constant baseline, the last encoded particles."""

        def constant(state):
            newest = last_steps(state, 1)
            return [replace(newest, cloud_step=newest.cloud_step + 1 + i) for i in range(self.n_steps)]

        return self._psnr(self.restored, constant)

    def _psnr(self, restored: Restored, predict: Callable) -> float:
        """Returns the PSNR in dB of ``predict`` (state -> next steps); synchronises the device."""
        errors = []
        for state, video, first in zip(self.states, self.videos, self.first, strict=True):
            images = render_steps(restored, concatenate(predict(state)), self.scene, self.cams, first)
            errors.append(float((images - video).square().mean()))
        return -10 * math.log10(max(fmean(errors), 1e-10))
