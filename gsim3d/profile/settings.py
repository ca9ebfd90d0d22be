"""What can be turned to trade accuracy for time: each knob declared once, with what turning it may change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gsim3d.errors import InputError
from gsim3d.io.files import shown, typed
from gsim3d.ops.raster import CUTOFFS
from gsim3d.profile.products import compiler_problem, why_not

if TYPE_CHECKING:
    from gsim3d.profile.subject import Subject

PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
PARTS = ("encoder", "dynamics", "renderer")
KINDS = {
    "exact": "changes what is simulated by rounding only",
    "near-exact": "leaves out what is below a stated threshold",
    "model": "changes the function that the model computes",
    "needs-training": "needs a checkpoint of its own",
}


@dataclass(frozen=True)
class Setting:
    """How a trained simulator is run. The default is the reference: float32 throughout, nothing left out.

    encoder, dynamics, renderer: precision of each part, "fp32", "tf32", "bf16" or "fp16"; positions, codes, splats and
        sums are float32 in all.
    captured: the rollout is replayed from a CUDA graph.
    context_views, history: input cameras and steps; None: those of the training.
    background: as EffectsSpec.dynamics.background; None: that of the training.
    kept: share of the particles of each step, moving and other ones alike, that is kept: the most opaque.
    sh_degree: of rendered colours; None: the model's.
    cutoff: as :func:`gsim3d.ops.rasterize_gaussians`.
    least_opacity: Gaussians below it are not drawn; pixels leave out what is below 1/255 in any case.
    patch_size: largest number of rows that attend to each other; None: the model's.
    grid: factor to the model's cell size.
    shrink: images are rendered this factor smaller, and enlarged again to be compared.
    every: steps between two rendered ones.
    compiled: the network of the dynamics runs through torch.compile.
    sleep: cells that a particle at rest moves in one step at most, and is not computed; None: as in the training.
    orders: of the curves that cut clouds into patches; the predictions of as many are averaged, at most 4.
    checkpoint: name of another one that takes this one's place; None: none does.
    """

    encoder: str = "fp32"
    dynamics: str = "fp32"
    renderer: str = "fp32"
    captured: bool = False
    context_views: int | None = None
    history: int | None = None
    background: str | None = None
    kept: float = 1.0
    sh_degree: int | None = None
    cutoff: str = "exact"
    patch_size: int | None = None
    grid: float = 1.0
    shrink: int = 1
    every: int = 1
    least_opacity: float = 0.0
    compiled: bool = False
    sleep: float | None = None
    orders: int = 1
    checkpoint: str | None = None

    def __post_init__(self):
        for part in PARTS:
            _require(part, getattr(self, part), getattr(self, part) in PRECISIONS, f"one of {', '.join(PRECISIONS)}")
        _require("cutoff", self.cutoff, self.cutoff in CUTOFFS, f"one of {', '.join(CUTOFFS)}")
        _require("kept", self.kept, 0 < self.kept <= 1, "above 0 and at most 1")
        _require("grid", self.grid, 0 < self.grid < 1e3, "above 0")
        _require("least_opacity", self.least_opacity, 0 <= self.least_opacity < 1, "at least 0 and below 1")
        _require("sleep", self.sleep, self.sleep is None or 0 <= self.sleep < 1e3, "at least 0")
        _require("orders", self.orders, self.orders in (1, 2, 4), "1, 2 or 4")
        if self.captured and self._needs_python:
            raise InputError("setting: captured does not fit " + " and ".join(self._needs_python))
        _require("sh_degree", self.sh_degree, self.sh_degree in (None, 0, 1, 2, 3), "0, 1, 2 or 3")
        for name in ("context_views", "history", "patch_size", "shrink", "every"):
            value = getattr(self, name)
            _require(name, value, value is None or (isinstance(value, int) and value >= 1), "an integer of at least 1")

    @property
    def _needs_python(self) -> list[str]:
        """What of it a graph cannot repeat: it knows no sleep, and one order of the curves."""
        changed = {name: getattr(self, name) for name in ("compiled", "sleep", "orders")}
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        return [name for name, value in changed.items() if value != defaults[name]]

    @property
    def fits_a_graph(self) -> bool:
        """Whether what it changes can be replayed from a CUDA graph."""
        return not self._needs_python

    @property
    def name(self) -> str:
        """What differs from the reference, in words."""
        changed = self.to_dict()
        if precisions := {changed.pop(part, "fp32") for part in PARTS} - {"fp32"}:
            parts = [part for part in PARTS if getattr(self, part) != "fp32"]
            where = "" if len(parts) == len(PARTS) else f" {'+'.join(parts)}"
            changed = {"precision": f"{'/'.join(sorted(precisions))}{where}", **changed}
        for switch, what in (("captured", "graph captured"), ("compiled", "compiled")):
            if changed.pop(switch, False):
                changed = {what: "", **changed}
        return (
            ", ".join(f"{key.replace('_', ' ')} {_short(value)}".strip() for key, value in changed.items())
            or "reference"
        )

    @property
    def undrawn(self) -> Setting:
        """What of it changes the particles."""
        drawing = {
            "renderer": "fp32",
            "sh_degree": None,
            "cutoff": "exact",
            "least_opacity": 0.0,
            "shrink": 1,
            "every": 1,
        }
        return dataclasses.replace(self, **drawing)

    @property
    def given(self) -> Setting:
        """What of it changes the encoder's work."""
        names = ("encoder", "context_views", "history", "checkpoint")
        return Setting(**{name: getattr(self, name) for name in names})

    def to_dict(self) -> dict[str, Any]:
        """Fields that differ from the reference."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Setting:
        """Raises InputError for an unknown key or a value of another type."""
        return typed(cls, values, "setting")


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


def _require(name: str, value: object, fine: bool, what: str) -> None:
    if not fine:
        raise InputError(f"setting: {name} must be {what}; got {shown(value)}")


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


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
