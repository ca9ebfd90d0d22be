"""Every effect, edit and mixed batch gives on a GPU what it gives on the CPU, in float64."""

import pytest
import torch

from gsim3d.effects.edits import Duplicate, Edit, Move, Recolor, Remove, Rotate, Throw
from gsim3d.effects.spec import EffectsSpec
from tests.asserts import assert_close_relative_to_max
from tests.effects.models import MODELS, Case
from tests.effects.test_off_effects import EFFECTS
from tests.effects.test_plans_of_one_batch import SPECS

EDITS = [
    Edit(0, Recolor("moving", (0.8, 0.2, 0.1))),
    Edit(0, Rotate("moving", axis=(0.0, 0.0, 1.0), degrees=30.0)),
    Edit(1, Duplicate("moving", (0.3, 0.0, 0.0))),
    Edit(1, Throw("moving", (0.0, 0.0, 0.02))),
    Edit(1, Move("frozen", (0.0, 0.0, 0.1))),
    Edit(2, Remove("frozen")),
]
ON = EffectsSpec.from_dict({"structure": {"insert": True, "remove": True}, "outputs": {"depth": True}})


def cases(devices, model="latent", steps=(2,), n_steps=1):
    for device in devices:
        case = Case(MODELS[model], steps, n_steps)
        case.simulator.double().to(device)
        case.state = case.state.map(lambda t: t.double() if t.is_floating_point() else t).to(device)
        case.cameras = case.cameras.to(device)
        yield case


def assert_equal(results, what):
    (cpu_steps, cpu_image), (cuda_steps, cuda_image) = results
    for step, other in zip(cuda_steps, cpu_steps, strict=True):
        for name, value in other.row_fields().items():
            assert_close_relative_to_max(getattr(step, name).cpu(), value, 1e-9, f"{what}: {name}")
    for name, value in cpu_image._asdict().items():
        if value is not None:
            assert_close_relative_to_max(getattr(cuda_image, name).cpu(), value, 1e-9, f"{what}: {name}")


def test_plan(devices):
    for name, (model, on, off, _) in EFFECTS.items():
        for values in (on, off):
            results = [case(EffectsSpec.from_dict(values)) for case in cases(devices, model)]
            assert_equal(results, f"{name}, {values}")


def launches(call) -> int:
    """How many kernels, copies and fills the GPU is given."""
    call()  # constants are made once
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        call()
        torch.cuda.synchronize()
    return sum(event.device_type == torch.autograd.DeviceType.CUDA for event in profile.events())


LAUNCHED = ["history", "sleep", "changing", "frozen_appearance", "opacity_changes", "features"]


@pytest.mark.parametrize("name", LAUNCHED)
def test_off_effect_launches_fewer_kernels(name, devices):
    model, on, off, _ = EFFECTS[name]
    *_, case = cases(devices, model)
    counts = [launches(lambda: case(EffectsSpec.from_dict(values))) for values in (off, on)]
    assert 0 < counts[0] < counts[1], counts


def test_edits(devices):
    for model in ("latent", "explicit"):
        results = [case(ON, edits=EDITS) for case in cases(devices, model, n_steps=3)]
        assert results[0][0][0].n_rows < results[0][0][1].n_rows > results[0][0][2].n_rows
        assert_equal(results, model)


@torch.no_grad()
def test_plans_of_one_batch(devices):
    results = []
    for case in cases(devices, steps=(2, 3, 1, 2)):
        plans = [case.simulator.plan(spec) for spec in SPECS]
        steps = case.simulator.rollout(case.state, 2, plans=plans)
        results.append((steps, case.simulator.render(steps[-1], case.cameras, plans=plans)))
    assert_equal(results, "batch")
