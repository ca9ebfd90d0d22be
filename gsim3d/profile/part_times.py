"""What the parts of a step took where they were measured, and what that says of another plan and another scene."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

from gsim3d.effects.plan import Plan, Workload, predicted_cost
from gsim3d.errors import InputError
from gsim3d.io.files import typed
from gsim3d.presets import ModelConfig
from gsim3d.profile import machine
from gsim3d.profile.measure import Point
from gsim3d.profile.subject import MOST_KEPT, Subject
from gsim3d.profile.timing import GAPS
from gsim3d.state import DYNAMIC

PART_OF_STAGE = {"head": "gaussians", "sort and raster": "images", GAPS: "host"}  # all others: the dynamics


@dataclass(frozen=True)
class PartTimes:
    """Of the reference: what computes as the checkpoint's spec says, in float32, launched call by call.

    on: the machine.   work: a step of the scenes that it was measured on, and its images.
    dynamics, gaussians, images: milliseconds of the parts that :func:`gsim3d.effects.plan.predicted_cost` tells apart.
    host: milliseconds in which a GPU waits for the host.
    """

    on: str
    work: Workload
    dynamics: float = 0.0
    gaussians: float = 0.0
    images: float = 0.0
    host: float = 0.0

    def __post_init__(self):
        if not all(type(count) is int and count >= 0 for count in asdict(self.work).values()):
            raise InputError(f"work must hold counts; got {asdict(self.work)}")

    @classmethod
    def of(cls, subject: Subject, reference: Point) -> PartTimes | None:
        """Of a reference that was timed on ``subject``; None where its stages were not told apart."""
        if not reference.stages():
            return None
        parts: dict[str, float] = {}
        for stage, seconds in reference.stages().items():
            part = PART_OF_STAGE.get(stage, "dynamics")
            parts[part] = parts.get(part, 0.0) + 1e3 * seconds
        starts = [subject.start(subject.runner(), number) for number in range(len(subject.scenes))[:MOST_KEPT]]
        newest = [subject.runner().newest(start).activity for start in starts]
        moving, rows = (round(fmean(counts)) for counts in zip(*((int((a == DYNAMIC).sum()), len(a)) for a in newest)))
        height, width = subject.restored.image_size
        work = Workload(moving, rows - moving, len(subject.views[0][1]), height * width)
        facts = machine.facts(subject.device)
        return cls(", ".join(str(facts[name]) for name in ("processor", "device") if name in facts), work, **parts)

    @classmethod
    def from_dict(cls, values: Any, where: str) -> PartTimes:
        """From plain values, such as ``dataclasses.asdict`` makes."""
        return typed(cls, values, where)

    def predicted(self, own: Plan, plan: Plan, model: ModelConfig, work: Workload) -> dict[str, float]:
        """Milliseconds of each part under ``plan``: as many times those measured as the multiply-adds are more.

        Args:
            own: the plan of the checkpoint, under which the times were measured.
            work: what ``plan`` is applied to.
        """
        before, after = predicted_cost(own, model, self.work), predicted_cost(plan, model, work)
        scaled = {part: getattr(self, part) * after[part] / max(before[part], 1.0) for part in after}
        return {**scaled, "host": self.host} if self.host else scaled
