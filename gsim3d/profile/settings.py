"""What can be turned to trade accuracy for time: each knob declared once, with what turning it may change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gsim3d.numerics.speed import PARTS, PRECISIONS, Setting
from gsim3d.profile.products import compiler_problem, why_not

if TYPE_CHECKING:
    from gsim3d.profile.subject import Subject

KINDS = {
    "exact": "changes what is simulated by rounding only",
    "near-exact": "leaves out what is below a stated threshold",
    "model": "changes the function that the model computes",
    "needs-training": "needs a checkpoint of its own",
}


@dataclass(frozen=True)
class Knob:
    """kind: a key of KINDS.

    turns: settings of a simulator on its device, each with only this knob turned; none, or why there is none.
    needs: what must be there, trained or built first, where ``turns`` gives nothing.
    few: turns in a report that takes the fewest: the last one, both ends, or what is evenly between them too.
    slow: takes minutes to turn.
    shown: the report has it, but not as settings of its own.
    """

    name: str
    kind: str
    turns: Callable[[Subject], list[Setting] | str]
    needs: str = ""
    few: int = 2
    slow: bool = False
    shown: bool = False


SLOW = "minutes: name it with --knobs, or take --preset full"


def turned(
    subject: Subject, knobs: Sequence[Knob], *, fewest: bool = False, slow: bool = True
) -> tuple[dict[Setting, Knob], dict[str, str]]:
    """(settings of all knobs, {knob that has none: what it needs}).

    fewest: as few as Knob says; of knobs that need training all.   slow: slow ones as well.
    """
    settings, missing = {}, {}
    for knob in knobs:
        found = knob.turns(subject) if slow or not knob.slow else SLOW
        if isinstance(found, str) or not found:
            if not knob.shown:
                missing[knob.name] = found or knob.needs
            continue
        if fewest and knob.kind != "needs-training" and len(found) > knob.few:
            apart = (len(found) - 1) / max(1, knob.few - 1)
            found = [found[-1 - int(n * apart)] for n in reversed(range(knob.few))]
        settings.update((_as_run(setting, subject), knob) for setting in found)
    return settings, missing


def _as_run(setting: Setting, subject: Subject) -> Setting:
    """On a GPU from a graph where it can be: else it waits for the host, and no knob makes that faster."""
    on_gpu = subject.device.type == "cuda"
    return dataclasses.replace(setting, captured=True) if on_gpu and setting.fits_a_graph else setting


def _powers_below(limit: int, least: int = 1) -> list[int]:
    return [n for n in (2**k for k in range(20)) if least <= n < limit]


def _precisions(subject: Subject) -> list[Setting]:
    if subject.device.type != "cuda":
        return []
    whole = [Setting(p, p, p) for p in PRECISIONS[1:]]
    encoder, dynamics, renderer = (Setting(**{part: "bf16"}) for part in PARTS)
    return [whole[0], encoder, renderer, dynamics, whole[2], whole[1]]  # tf32, bf16 of the dynamics, and bf16 if few


def _fp8(subject: Subject) -> str:
    return why_not(subject)


def _compiled(subject: Subject) -> list[Setting] | str:
    return compiler_problem(subject.device) or [Setting(compiled=True)]


def _captured(subject: Subject) -> list[Setting]:
    return [Setting(captured=True)] * (subject.device.type == "cuda")


def _views(subject: Subject) -> list[Setting]:
    return [Setting(context_views=n) for n in range(1, subject.restored.data.context_views)]


def _history(subject: Subject) -> list[Setting]:
    return [
        Setting(history=n) for n in _powers_below(min(subject.restored.data.history, subject.restored.plan.history))
    ]


def _background(subject: Subject) -> list[Setting]:
    trained = subject.restored.plan.spec.dynamics.background
    return [Setting(background="masked_out")] if trained != "masked_out" else []


def _kept(subject: Subject) -> list[Setting]:
    return [Setting(kept=share) for share in (0.75, 0.5, 0.25, 0.1)]


def _degrees(subject: Subject) -> list[Setting]:
    return [Setting(sh_degree=n) for n in range(subject.restored.plan.sh_degree)]


def _cutoffs(subject: Subject) -> list[Setting]:
    return [Setting(cutoff="tile3sigma"), *(Setting(least_opacity=least) for least in (1 / 255, 0.02))]


def _sleeping(subject: Subject) -> list[Setting]:
    return [Setting(sleep=cells) for cells in (1e-3, 1e-2, 0.1)]


def _orders(subject: Subject) -> list[Setting]:
    config = subject.restored.simulator.config.dynamics
    return [] if config.is_asymmetric or config.steps_per_call > 1 else [Setting(orders=4), Setting(orders=2)]


def _patches(subject: Subject) -> list[Setting]:
    largest = max(subject.restored.simulator.config.dynamics.patch_sizes)
    return [Setting(patch_size=n) for n in reversed(_powers_below(largest, 32)[-3:])]


def _grids(subject: Subject) -> list[Setting]:
    return [Setting(grid=factor) for factor in (0.5, 2.0)]


def _images(subject: Subject) -> list[Setting]:
    return [Setting(shrink=2), Setting(every=4)]


def _horizon(subject: Subject) -> list[Setting]:
    return []


def _others(knob: str) -> Callable[[Subject], list[Setting]]:
    return lambda subject: [Setting(checkpoint=name) for name, of in subject.knob_of_other.items() if of == knob]


KNOBS = (
    Knob("precision", "model", _precisions, "a GPU: on a CPU there is only float32", few=3),
    Knob("fp8 products", "model", _fp8, "wider layers, see below"),
    Knob("compile", "exact", _compiled, "a compiler; up to 2 minutes, so `quick` leaves it out", slow=True),
    Knob("graph capture", "exact", _captured, "a GPU"),
    Knob("context views", "model", _views, "more than one context view"),
    Knob("history", "model", _history, "a model of more than one step of history"),
    Knob("background", "model", _background, "particles of a background"),
    Knob("particles kept", "model", _kept),
    Knob("degree of colours", "model", _degrees, "a model with view-dependent colour"),
    Knob("cutoff of Gaussians", "near-exact", _cutoffs),
    Knob("sleep", "near-exact", _sleeping, few=1),
    Knob("patch size", "model", _patches, "patches of more than 32 rows", few=1),
    Knob("orders of curves", "model", _orders, "one step a call, and no asymmetric background", few=1),
    Knob("grid size", "model", _grids),
    Knob("image size and decoded frames", "exact", _images),
    Knob("horizon", "exact", _horizon, "a table and a figure of its own", shown=True),
    Knob(
        "steps a call",
        "needs-training",
        _others("steps a call"),
        "`--others`: dynamics.steps_per_call in the training's model section",
    ),
    Knob(
        "model size",
        "needs-training",
        _others("model size"),
        "`--others`: another preset, or channels in the training's model section",
    ),
    Knob(
        "training steps",
        "needs-training",
        _others("training steps"),
        "a run folder with earlier checkpoints, or `--others`; the log has a figure of its own",
    ),
)
# What is simulated is tuned, not what is looked at nor what is trained; a command compiles longer than it then runs.
NOT_TUNED = ("image size and decoded frames", "steps a call", "model size", "training steps", "compile")
