"""Rollouts of a small simulator from states that no encoder made."""

import dataclasses

import pytest
import torch
from torch import Tensor

from gsim3d.errors import NumericalError
from gsim3d.numerics.report import StabilityReport
from gsim3d.presets import ModelConfig
from gsim3d.simulator import Simulator
from gsim3d.state import Particles
from tests.dynamics.scenes import float_fields, make_history
from tests.stability.setting import Measured, Setting
from tests.test_simulator import CONFIG


def make_simulator(setting: Setting, *, prepare=None, config: ModelConfig = CONFIG, **dynamics) -> Simulator:
    """A simulator with random weights in evaluation; ``dynamics`` changes its configuration of the dynamics."""
    torch.manual_seed(0)
    simulator = Simulator(dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, **dynamics)))
    if prepare is not None:
        prepare(simulator)
    return setting.to(simulator).eval()


def ordinary() -> Particles:
    return make_history((12, 9), seed=11)


def of_scene(particles: Particles, scene: int) -> dict[str, Tensor]:
    """Floating-point fields of the rows of one scene of a step."""
    rows = slice(int(particles.cu_rows[scene]), int(particles.cu_rows[scene + 1]))
    return {name: value[rows] for name, value in float_fields(particles).items()}


def finite(measured: Measured, steps: list[Particles]) -> None:
    for step in steps:
        measured.finite(*float_fields(step).values())


def raised(call, report: StabilityReport) -> NumericalError:
    """The error of a call, from the call itself or, on a GPU, from its report."""
    with pytest.raises(NumericalError) as caught:
        call()
        report.check()
    return caught.value
