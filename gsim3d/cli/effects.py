"""``gsim3d effects infer``: the smallest spec under which a model predicts a scene as well as under its own."""

from __future__ import annotations

import argparse

from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP, add_fitting

EPILOG = """\
Each effect that the checkpoint's spec has on is switched off alone, or lowered, and predictions of four steps at the
film's begin, middle and end are compared with it: what it is worth is how many dB of PSNR that loses, what it costs is
the time of a step and its images that it takes. The smallest settings within the tolerance are taken together; while
together they lose more, the one that is worth most comes back. What is measured as slower is not proposed.

It is the model that is measured: where its predictions are hardly better than particles held still (the first line
tells both), it has not learned what the effects are for, and the proposal says little about the scene. Times of a few
milliseconds waver; let nothing else run.

examples:
  gsim3d effects infer runs/data/ball/0000 runs/model --tolerance 0.1dB
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/ball --effects runs/data/ball/0000/effects.yaml
"""
WINDOWS, STEPS = 3, 4  # spread over the film, and steps predicted and compared in each
ROUNDS = 3  # of which the fastest counts


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Finds out which effects a scene needs, and writes them to effects.yaml."
    parser.epilog = EPILOG
    parser.add_argument("action", choices=("infer",), help="infer: switch effects off one by one and compare")
    parser.add_argument("scene", metavar="SCENE", help="scene folder of any layout (docs/data.md)")
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    parser.add_argument("--tolerance", default="0.1dB", metavar="X", help="PSNR that may be lost (default: 0.1dB)")
    parser.add_argument("--out", metavar="FILE", help="file to write; must not exist yet (default: SCENE/effects.yaml)")
    add_fitting(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")


def run(args: argparse.Namespace) -> int:
    import textwrap
    from pathlib import Path

    from gsim3d.effects.plan import in_columns
    from gsim3d.effects.spec import FILE
    from gsim3d.io.files import new_output_path, with_parents
    from gsim3d.train.restore import restore

    tolerance = _decibels(args.tolerance)
    out = new_output_path(args.out or Path(args.scene) / FILE, "file")
    restored = restore(args.checkpoint, args.device)
    scene = restored.open_scene(args.scene, args.keep, args.resample)
    base = restored.plan.spec
    settings = smaller(base, restored.simulator.config)
    with progress(None, "settings", 2 + sum(map(len, settings.values())), unit="setting", quiet=args.quiet) as bar:
        trial = _Trial(restored, scene, bar)
        psnr, seconds = trial(base)
        rows, spec, (now, time) = propose(base, settings, trial, (psnr, seconds), tolerance)
    print(
        f"{scene.name}: {psnr:.2f} dB with what the checkpoint has on, {trial.held_still():.2f} dB with particles held "
        f"still; {1e3 * seconds:.1f} ms a step with images of {len(trial.cams)} cameras\n"
    )
    print(in_columns([("effect", "setting", "worth dB", "costs ms", ""), *rows]))
    spec.save(with_parents(out))
    print(f"\nproposed: {now:.2f} dB ({now - psnr:+.3f}), {seconds / time:.2f} times as fast; written to {out}:")
    print(textwrap.indent(out.read_text(), "  ").rstrip())
    return 0


def propose(base, settings: dict, trial, measured: tuple[float, float], tolerance: float):
    """Rows of a table, the smallest spec that loses at most ``tolerance`` dB of ``measured`` and takes no longer, and
    its own measurement: ``base`` where none is as good and as fast.

    Args:
        settings: of :func:`smaller`.
        trial: spec -> PSNR, seconds.   measured: those of ``base``.
    """
    psnr, seconds = measured
    table, chosen, lost, saved, put_back = [], {}, {}, {}, {}
    for effect, specs in settings.items():
        for name, spec in specs:
            now, time = trial(spec)
            fits = psnr - now <= tolerance
            if effect not in chosen and fits and time <= seconds:
                chosen[effect], lost[effect], saved[effect] = spec, psnr - now, seconds - time
            table.append((effect, name, psnr - now, seconds - time, chosen.get(effect) is spec, fits))
    while True:
        spec = together(base, chosen.values())
        now, time = trial(spec) if chosen else measured
        if psnr - now > tolerance:
            back, why = max(chosen, key=lost.get), "too much with the others"
        elif time > seconds:
            back, why = min(chosen, key=saved.get), "slower with the others"
        else:
            break
        del chosen[back]
        put_back[back] = why
    rows = []
    for effect, name, worth, cost, picked, fits in table:
        note = "slower" if fits and cost < 0 else ""
        if picked:
            note = put_back.get(effect, "proposed")
        rows.append((effect, name, f"{worth:+.3f}", f"{1e3 * cost:+.1f}", note))
    return rows, spec, (now, time)


def _decibels(text: str) -> float:
    import math

    from gsim3d.errors import InputError

    try:
        value = float(text.removesuffix("dB"))
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise InputError(f"--tolerance: must be a number of dB of at least 0, such as 0.1dB; got {text!r}")
    return value


def smaller(base, model) -> dict:
    """Effect -> (setting, ``base`` with that setting) for each setting below its own, the smallest first."""
    from dataclasses import replace

    from gsim3d.effects.plan import make_plan

    plan, dynamics, look = make_plan(base, model), base.dynamics, base.appearance
    history = [2**bits for bits in range(model.dynamics.history_bits + 1) if 2**bits < plan.history]
    found = {
        "time merging": [
            (f"{n} step{'s' if n > 1 else ''}", replace(base, dynamics=replace(dynamics, history=n))) for n in history
        ],
        "view-dependent colour": [
            (f"degree {d}", replace(base, appearance=replace(look, view_dependent=d))) for d in range(plan.sh_degree)
        ],
        "changing features": [
            (who, replace(base, appearance=replace(look, changing=who)))
            for who in {"all": ("none", "dynamic"), "none": ()}.get(look.changing, ("none",))
        ],
        "changing opacities": (
            [("off", replace(base, appearance=replace(look, opacity_changes=False)))]
            if "changing opacities" in plan.kept
            else []
        ),
        "frozen background": (
            [("masked out", replace(base, dynamics=replace(dynamics, background="masked_out")))]
            if "frozen background" in plan.kept
            else []
        ),
    }
    return {effect: settings for effect, settings in found.items() if settings}


def together(base, specs):
    """``base`` with every setting in which one of ``specs`` differs from it."""
    from dataclasses import fields, replace

    spec = base
    for other in specs:
        for room in fields(base):
            mine, theirs = getattr(base, room.name), getattr(other, room.name)
            changed = {f.name: getattr(theirs, f.name) for f in fields(mine)}
            changed = {name: value for name, value in changed.items() if value != getattr(mine, name)}
            spec = replace(spec, **{room.name: replace(getattr(spec, room.name), **changed)})
    return spec


class _Trial:
    """spec -> PSNR of short predictions of the scene against its film, seconds of a step and its images."""

    def __init__(self, restored, scene, bar):
        import numpy as np

        from gsim3d.evaluate.protocol import default_views, encode_steps, horizon

        self.restored, self.scene, self.bar, n_encoded = restored, scene, bar, restored.data.history
        self.n_steps = min(STEPS, horizon(scene, n_encoded, None))
        context, self.cams = default_views(restored, scene)
        last = scene.n_steps - n_encoded - self.n_steps
        starts = np.unique(np.linspace(0, last, WINDOWS).round().astype(int)).tolist()
        self.first = [start + n_encoded for start in starts]  # predicted steps of the film
        self.states = [encode_steps(restored, scene, context, start) for start in starts]
        films = [scene.images(list(self.cams), range(first, first + self.n_steps)) for first in self.first]
        self.films = [film.permute(0, 1, 3, 4, 2).to(restored.device).float() / 255 for film in films]

    def __call__(self, spec) -> tuple[float, float]:
        import time
        from dataclasses import replace

        restored, times = replace(self.restored, plan=self.restored.simulator.plan(spec)), []
        for _ in range(ROUNDS):
            start = time.perf_counter()
            psnr = self._psnr(restored, lambda state: restored.simulator.rollout(state, self.n_steps, restored.plan))
            times.append(time.perf_counter() - start)
        self.bar.total = max(self.bar.total, self.bar.n + 1)  # sets of settings may be tried several times
        self.bar.update()
        return psnr, min(times) / self.n_steps / len(self.films)

    def held_still(self) -> float:
        """PSNR of the last encoded particles in place of predicted ones."""
        from dataclasses import replace

        from gsim3d.dynamics import last_steps

        def held(state):
            newest = last_steps(state, 1)
            return [replace(newest, cloud_step=newest.cloud_step + 1 + i) for i in range(self.n_steps)]

        return self._psnr(self.restored, held)

    def _psnr(self, restored, predict) -> float:
        """predict: state -> the next steps. Waits for the device."""
        import math
        from statistics import fmean

        import torch

        from gsim3d.dynamics import concatenate
        from gsim3d.evaluate.protocol import render_steps
        from gsim3d.nn.layers import exact_convolutions

        errors = []
        with torch.no_grad(), exact_convolutions():
            for state, film, first in zip(self.states, self.films, self.first, strict=True):
                images = render_steps(restored, concatenate(predict(state)), self.scene, self.cams, first)
                errors.append(float((images - film).square().mean()))
        return -10 * math.log10(max(fmean(errors), 1e-10))
