"""Invariances and stress tests of a model on scenes, with files that reproduce failures (``gsim3d doctor``)."""

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsim3d import presets
from gsim3d.cameras import Cameras, Frames
from gsim3d.compat.released_model import ReleasedSimulator
from gsim3d.data import Scene, find_scenes, make_frames
from gsim3d.data.check import check_scene
from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import whole_file, write_whole
from gsim3d.io.terminal import progress
from gsim3d.pretrained import known_failures, located, names
from gsim3d.simulator import Simulator
from gsim3d.synth.cameras import look_at
from gsim3d.testing.invariances import INVARIANCES, Deviation, Sample
from gsim3d.testing.stress import STRESS_TESTS
from gsim3d.train.log import plain
from gsim3d.train.restore import PRESETS, Restored, build_simulator, restore
from gsim3d.train.samples import context_cameras, spread_views, subsampled

CHECKS = {**INVARIANCES, **STRESS_TESTS}
LONG = "a long rollout"
SHORT = 3  # steps of all other checks
N_STEPS = 100
MAX_SCENES, MAX_HISTORY, MAX_PIXELS = 2, 2, 150  # scenes, input steps, and pixels of an image, of a quick check
FULL_VIEWS = 4  # views of a full check
FORMAT = 1
RANDOM_SIZE = 32  # width and height of random images


@dataclass(frozen=True)
class Finding:
    """Result of a check."""

    check: str  #: name of the check
    outcome: str  #: "holds", "fails", "known failure" (listed in the model card) or "not promised"
    n_compared: int = 0  #: number of compared tensors
    seconds: float = 0.0  #: duration of the check
    worst: Deviation | None = None  #: deviation with the largest error relative to its bound
    failures: tuple[Deviation, ...] = ()  #: deviations above their bounds
    file: str | None = None  #: file that reproduces the failures
    reason: str | None = None  #: why the check is not promised, or the entry of the model card


@dataclass(frozen=True)
class Report:
    """Results of all checks."""

    subject: dict[str, str]  #: description of the model and its inputs
    problems: tuple[str, ...] = ()  #: problems of scenes that could not be read
    findings: tuple[Finding, ...] = ()  #: one finding for each check

    @property
    def healthy(self) -> bool:
        return not self.problems and all(finding.outcome in ("holds", "not promised") for finding in self.findings)


@dataclass(frozen=True)
class Subject:
    """A simulator to check."""

    simulator: Simulator  #: the simulator
    origin: dict[str, str]  #: its checkpoint or preset
    restored: Restored | None = None  #: restored checkpoint; None: random weights
    known: dict[str, dict] = dataclasses.field(default_factory=dict)  #: check -> failure listed in the model card

    def sample(self, frames: Frames, targets: Cameras, n_steps: int = SHORT) -> Sample:
        """A sample on the simulator's device, with the plan of its training."""
        device = next(self.simulator.parameters()).device
        plan = self.restored.plan if self.restored else None
        return Sample(frames.to(device), targets.to(device), n_steps, plan)


def is_checkpoint(path: Path) -> bool:
    """Whether ``path`` is a run folder, a checkpoint folder or an exported file."""
    if path.is_file():
        return path.suffix == ".safetensors"
    return (path / "checkpoints").is_dir() or (path / "state.json").is_file()


def open_subject(path: str | Path | None, device: str = "cpu") -> Subject:
    """Opens a checkpoint, or builds a preset (None: "tiny") with nonzero random weights."""
    preset = "tiny" if path is None else str(path)
    if preset not in PRESETS:
        restored = restore(path, device)
        restored.simulator.requires_grad_()
        return Subject(restored.simulator, {"checkpoint": str(path)}, restored, known_failures(path))
    simulator = build_simulator(getattr(presets, preset)(), seed=0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in simulator.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return Subject(simulator.eval().to(device), {"preset": f"{preset}, random weights"})


def sample_of_scenes(subject: Subject, folders: Sequence[Path], full: bool = False) -> tuple[Sample | None, list[str]]:
    """Sample of the first steps of up to two valid scenes (None: no scene is valid), and problems of invalid ones;
    ``full``: of four views, the whole history and all particles."""
    scenes, problems = [], []
    for folder in folders:
        if len(scenes) == MAX_SCENES:
            break
        if found := check_scene(folder).problems:
            problems += found
            continue
        scene = subject.restored.open_scene(folder) if subject.restored else Scene.open(folder)
        if not scenes or (scene.width, scene.height) == (scenes[0].width, scenes[0].height):
            scenes.append(scene)
    if not scenes:
        return None, problems
    longest = 2**subject.simulator.config.dynamics.history_bits
    history = min(longest if full else MAX_HISTORY, longest, *(scene.n_steps for scene in scenes))
    cams = [_views(subject, scene, FULL_VIEWS if full else None) for scene in scenes]
    frames = make_frames(scenes, cams, [range(history)] * len(scenes))
    if not full:
        frames = _subsampled(frames)
    elif subject.restored is not None:
        frames = subsampled(frames, subject.restored.data)
    return subject.sample(frames, _first_cameras(frames)), problems


def _views(subject: Subject, scene: Scene, count: int | None = None) -> list[int]:
    cameras, usual = range(scene.n_cams), 3
    if subject.restored is not None:
        data = subject.restored.data_of(scene)
        cameras, usual = context_cameras(scene, data), data.context_views
    return list(spread_views(cameras, min(len(cameras), count or usual), 0))


def random_sample(subject: Subject) -> Sample:
    """Sample of random images: two scenes with two and one steps and three cameras on a ring."""
    size = (RANDOM_SIZE, RANDOM_SIZE) if subject.restored is None else subject.restored.image_size
    generator = torch.Generator().manual_seed(0)
    n_steps = (min(MAX_HISTORY, 2**subject.simulator.config.dynamics.history_bits), 1)
    n_clouds, n_views = sum(n_steps), 3
    angles = [0.4 + 2.0 * view for view in range(n_views)]
    centers = [np.array([2.0 * math.cos(angle), 2.0 * math.sin(angle), 1.0]) for angle in angles]
    viewmats = torch.from_numpy(np.stack([look_at(center, np.zeros(3)) for center in centers])).float()
    K = torch.tensor([[1.2 * size[0], 0, size[0] / 2], [0, 1.2 * size[0], size[1] / 2], [0, 0, 1]])
    n, pixels = n_clouds * n_views, size[::-1]
    cameras = Cameras(
        viewmats.repeat(n_clouds, 1, 1),
        K.repeat(n, 1, 1),
        torch.full((n,), 1.0),
        torch.full((n,), 4.0),
        torch.arange(n_clouds).repeat_interleave(n_views),
        *size,
    )
    frames = Frames(
        images=torch.rand(n, 3, *pixels, generator=generator),
        cameras=cameras,
        cloud_scene=torch.repeat_interleave(torch.arange(2), torch.tensor(n_steps)),
        cloud_step=torch.cat([torch.arange(steps) for steps in n_steps]),
        origin=torch.full((2, 3), -5.0, dtype=torch.float64),
        masks=torch.rand(n, *pixels, generator=generator) < 0.3,
        dynamic=torch.rand(n, *pixels, generator=generator) < 0.7,
    )
    return subject.sample(_subsampled(frames), _first_cameras(frames))


def _subsampled(frames: Frames) -> Frames:
    """Reduces the masks to at most MAX_PIXELS evenly spaced pixels of each image."""
    kept = torch.ones_like(frames.images[:, 0], dtype=torch.bool) if frames.masks is None else frames.masks
    number = kept.flatten(1).cumsum(1)
    every = (number[:, -1:] + MAX_PIXELS - 1).div(MAX_PIXELS, rounding_mode="floor").clamp(min=1)
    return dataclasses.replace(frames, masks=kept & ((number - 1) % every == 0).view(kept.shape))


def _first_cameras(frames: Frames) -> Cameras:
    """Cameras of the first step of every scene; ``image_cloud`` is the scene."""
    scene_of_image = frames.cloud_scene[frames.cameras.image_cloud]
    first = (frames.cloud_step[frames.cameras.image_cloud] == 0).nonzero()[:, 0]
    return frames.cameras.select(first, scene_of_image[first])


def check(
    subject: Subject,
    sample: Sample,
    n_steps: int = N_STEPS,
    only: Sequence[str] = (),
    on_check: Callable = lambda name: None,
) -> Iterator[tuple[Finding, Sample]]:
    """Runs all checks, or those in ``only``, and yields each finding with its sample; the long rollout has ``n_steps``.
    ``on_check`` is called with the name of each check before it runs."""
    released = isinstance(subject.simulator, ReleasedSimulator)  # its clouds are not independent
    for name in only or CHECKS:
        on_check(name)
        tried = dataclasses.replace(sample, n_steps=n_steps if name == LONG else SHORT)
        if released and name in INVARIANCES and name != "repeat":
            yield Finding(name, "not promised", reason="the published model does not have this invariance"), tried
            continue
        start, crash, deviations = time.perf_counter(), None, []
        try:
            deviations.extend(CHECKS[name](subject.simulator, tried))
        except Exception as error:  # counts as a failure of this check
            message = " ".join(str(error).split())[:300]
            crash = Deviation(f"ends with {type(error).__name__}", math.inf, 0.0, message)
            deviations.append(crash)
        failures = tuple(deviation for deviation in deviations if not deviation.holds)
        worst = max(deviations, key=lambda d: d.error / d.bound if d.bound else d.error, default=None)
        seconds = time.perf_counter() - start
        outcome, reason = "fails" if failures else "holds", None
        if failures and (card := subject.known.get(name)) and crash is None:
            outcome = "known failure"
            reason = f"known failure, in the model card: {card['what']} {card['error']:.3g} (at most {card['bound']:g})"
        yield Finding(name, outcome, len(deviations), seconds, worst, failures, reason=reason), tried


def save_sample(path: Path, sample: Sample, what: dict) -> None:
    """Writes the sample of a check to a .safetensors file, with ``what``: name of the check and origin of the model."""
    parts = {"frames": sample.frames, "cameras": sample.frames.cameras, "targets": sample.targets}
    tensors = {f"{part}.{k}": v for part, of in parts.items() for k, v in vars(of).items() if isinstance(v, Tensor)}
    size = {"width": sample.targets.width, "height": sample.targets.height, "n_steps": sample.n_steps}
    text = {"gsim3d_stability": json.dumps({"format": FORMAT, **size, **what})}
    with whole_file(path) as part:
        save_file({k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}, part, text)


def load_sample(path: str | Path) -> tuple[Sample, dict]:
    """Reads sample and ``what`` of :func:`save_sample`. Raises InputError for other files."""
    try:
        if not Path(path).is_file():  # reading a pipe would block
            raise InputError(f"{path}: no such file")
        with safe_open(path, "pt") as file:
            what = json.loads((file.metadata() or {})["gsim3d_stability"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        if what.get("format") != FORMAT or what["check"] not in CHECKS:
            raise KeyError("format")
        parts: dict[str, dict] = {"frames": {}, "cameras": {}, "targets": {}}
        for name, value in tensors.items():
            part, _, key = name.partition(".")
            parts[part][key] = value
        size = {"width": int(what["width"]), "height": int(what["height"])}
        frames = Frames(cameras=Cameras(**parts["cameras"], **size), **parts["frames"])
        return Sample(frames, Cameras(**parts["targets"], **size), int(what["n_steps"])), what
    except (OSError, MemoryError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a file that gsim3d doctor --stability wrote ({type(error).__name__})") from None


def write_report(report: Report, out: Path) -> None:
    """Writes report.md and report.json to the folder ``out``."""
    lines = ["# Stability", "", *(f"- {name}: {value}" for name, value in report.subject.items()), ""]
    if report.problems:
        lines += ["## Scenes that cannot be read", "", *(f"- {problem}" for problem in report.problems), ""]
    lines += ["| check | outcome | compared | worst | seconds |", "| --- | --- | --- | --- | --- |"]
    for finding in report.findings:
        worst = "; ".join(filter(None, (finding.reason, str(finding.worst) if finding.worst else None)))
        cells = [finding.check, finding.outcome, str(finding.n_compared), worst, f"{finding.seconds:.1f}"]
        lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    for finding in report.findings:
        if finding.failures:
            lines += ["", f"## {finding.check}", "", (CHECKS[finding.check].__doc__ or "").strip(), ""]
            lines += [f"- {deviation}" for deviation in finding.failures[:20]]
            lines += [f"- and {more} more"] if (more := len(finding.failures) - 20) > 0 else []
            lines += ["", f"Reproduce: `gsim3d doctor --stability --replay {finding.file}`"]
    values = json.dumps(plain({"healthy": report.healthy, **dataclasses.asdict(report)}), indent=1)
    for name, content in {"report.md": "\n".join(lines), "report.json": values}.items():
        write_whole(out / name, content, "\n")


def check_stability(
    paths: Sequence[str],
    out: Path,
    *,
    n_steps: int = N_STEPS,
    only: Sequence[str] = (),
    device: str = "cpu",
    full: bool = False,
    quiet: bool = False,
) -> Report:
    """Runs the checks and writes the report, and a file that reproduces each failure.

    Args:
        paths: a checkpoint and a scene or folder of scenes, in any order; none: random weights and images.
        out: folder of the report.
        n_steps: steps of the long rollout.
        only: names of checks; empty: all.
        device: "cpu" or "cuda".
        quiet: hides the progress bar.
        full: uses all particles, four views and the model's whole history.
    Raises:
        InputError: a path is neither a checkpoint nor a scene nor a folder of scenes, or a check is unknown.
    """
    if unknown := [name for name in only if name not in CHECKS]:
        raise InputError(
            f"--only: unknown check {unknown[0]!r}; checks: {', '.join(CHECKS)}{did_you_mean(unknown[0], CHECKS)}"
        )
    if n_steps < 1:
        raise InputError(f"--steps must be at least 1; got {n_steps}")
    found = [located(path) if str(path) in names() else Path(path) for path in paths]
    named = [*names(), *PRESETS]
    for path in found:
        if not path.exists() and str(path) not in PRESETS:
            raise InputError(f"{path}: no such file or folder{did_you_mean(path, named)}")
    checkpoints = [path for path in found if str(path) in PRESETS or is_checkpoint(path)]
    others = [path for path in found if path not in checkpoints]
    if len(checkpoints) > 1 or len(others) > 1:
        raise InputError("--stability takes one checkpoint, and one scene or folder of scenes")
    if full and not others:
        raise InputError("--full needs scenes: gsim3d doctor --stability NAME DATA --full")
    folders = find_scenes(others[0]) if others else []
    subject = open_subject(checkpoints[0] if checkpoints else None, device)
    origin = subject.origin | ({"scenes": str(others[0])} if others else {"scenes": "random images"})
    sample, problems = sample_of_scenes(subject, folders, full) if folders else (random_sample(subject), [])
    findings: list[Finding] = []
    if sample is not None:
        (out / "failures").mkdir(parents=True, exist_ok=True)
        with progress(None, "checks", len(only or CHECKS), unit="check", quiet=quiet) as bar:
            for finding, tried in check(subject, sample, n_steps, only, bar.set_description):
                if finding.failures:
                    file = out / "failures" / f"{finding.check.replace(' ', '_')}.safetensors"
                    save_sample(file, tried, {"check": finding.check, **subject.origin})
                    finding = dataclasses.replace(finding, file=str(file))
                findings.append(finding)
                bar.update()
    report = Report(origin, tuple(problems), tuple(findings))
    out.mkdir(parents=True, exist_ok=True)
    write_report(report, out)
    return report


def replay(path: str | Path, device: str = "cpu") -> Report:
    """Runs the check of a file of :func:`save_sample` on the model that it names."""
    sample, what = load_sample(path)
    subject = open_subject(what.get("checkpoint") or what["preset"].partition(",")[0], device)
    sample = subject.sample(sample.frames, sample.targets, sample.n_steps)
    findings = [finding for finding, _ in check(subject, sample, sample.n_steps, [what["check"]])]
    return Report(subject.origin | {"replayed": str(path)}, (), tuple(findings))


def describe(report: Report) -> str:
    """The report as text for a terminal."""
    lines = [f"{name}: {value}" for name, value in report.subject.items()]
    lines += [f"  FAIL problem: {problem}" for problem in report.problems]
    marks = {"holds": "ok", "fails": "FAIL", "known failure": "FAIL", "not promised": "-"}
    for finding in report.findings:
        mark = marks[finding.outcome]
        what = f"{finding.n_compared} compared in {finding.seconds:.1f} s" if finding.n_compared else ""
        what = "; ".join(filter(None, (what, finding.reason)))
        lines.append(f"  {mark:<4} {finding.check:<24} {what}")
        lines += [f"       {deviation}" for deviation in finding.failures[:3]]
        if finding.file:
            lines.append(f"       reproduce: gsim3d doctor --stability --replay {finding.file}")
    count = [finding.outcome for finding in report.findings].count
    if known := count("known failure"):
        new = f"{count('fails')} more" if count("fails") else "no other"
        lines.append(f"known failures, in the model card: {known}; {new} check fails")
    return "\n".join(lines)
