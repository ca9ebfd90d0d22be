"""Movable particles: compaction, gradients, and independence of the capacity."""

import dataclasses
from dataclasses import dataclass

import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.priors import DirectionalLightConfig, GravityConfig, InertiaConfig, Prior, PriorConfig, ShapeMatchingConfig
from gsim3d.priors.movable import Movable
from gsim3d.state import DYNAMIC, with_attribute
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import SEEING, TINY, batch, float_fields, make_dynamics, make_history
from tests.priors.scenes import with_priors

pytestmark = pytest.mark.usefixtures("one_thread")

CONDITIONED = with_priors(
    dataclasses.replace(TINY, background="relightable", priors=SEEING),
    InertiaConfig(radius=0.2, rotate_appearance=True),
    ShapeMatchingConfig(radius=0.2, stiffness=0.3),
    GravityConfig(radius=0.2),
    DirectionalLightConfig(directions=((0.1, 0.2, 1.0),)),
)


def scenes(device="cpu"):
    """Two scenes of different sizes; the first movable particle is outside the workspace."""
    history = with_attribute(
        batch([make_history((40, 40)), make_history((25, 25), seed=1, frozen_share=0.5)]), "velocity"
    )
    means, velocity = history.means.clone(), 0.01 * torch.randn(130, 3, generator=torch.Generator().manual_seed(0))
    means[40 + int((history.activity[40:] == DYNAMIC).to(torch.uint8).argmax())] = -1.0
    return dataclasses.replace(history, means=means, velocity=velocity).to(device)


def most(history):
    moves = history.activity == DYNAMIC
    return max(int(moves[a:b].sum()) for a, b in ((40, 80), (105, 130)))


def test_movable_particles_keep_order(device):
    history = scenes(device)
    exact, roomy, everything = (Movable(history, TINY.grid_size, n) for n in (most(history), 35, 40))
    assert exact.particles.rows.shape[1] == most(history) < 40
    table, inside = history.clouds, (history.means >= 0).all(1)
    for movable in (exact, roomy, everything):
        for b, q in enumerate(movable.newest):
            begin, end = table.starts[q], table.starts[q + 1]
            wanted = ((history.activity == DYNAMIC) & inside)[begin:end].nonzero()[:, 0] + begin
            assert_same_bits(movable.particles.rows[b][movable.particles.known[b]], wanted)
        assert_same_bits(movable.samples.positions, exact.samples.positions)
    newest = torch.cat([history.means[40:80], history.means[105:]])
    padded = exact.gather(newest)
    assert_same_bits(padded, torch.where(exact.particles.known[:, :, None], padded, 0))
    moves = torch.cat([((history.activity == DYNAMIC) & inside)[a:b] for a, b in ((40, 80), (105, 130))])
    assert_same_bits(exact.scatter(padded), torch.where(moves[:, None], newest, 0))


def test_packing_gradients():
    movable = Movable(scenes(), TINY.grid_size, 33)
    values = torch.randn(65, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: movable.scatter(movable.gather(x) ** 2), values)


def test_capacity_of_movable_particles_changes_nothing(device):
    history, dynamics = scenes(device), make_dynamics(CONDITIONED).to(device)
    gains = [prior.gain_head for prior in dynamics.priors if prior.gain_head]
    for parameter in (p for module in (dynamics.net.head, *gains) for p in module.parameters()):
        torch.nn.init.normal_(parameter, 0, 0.02, generator=torch.Generator(device).manual_seed(0))
    found = {}
    for n in (None, most(history), 36, 40):
        velocity = history.velocity.clone().requires_grad_()
        given = dataclasses.replace(history, velocity=velocity)
        if n is None:
            step = dynamics(given)
        else:
            with dynamics.moving_at_most(n):
                step = dynamics(given)
        (gradient,) = torch.autograd.grad(step.means.square().sum(), velocity)
        found[n] = {
            **float_fields(step),
            "orientations": step.orientations,
            "irradiance_gain": step.irradiance_gain,
            "gradient": gradient,
        }
    assert found[None]["gradient"].any()
    for n in (most(history), 36, 40):
        for name, value in found[n].items():
            assert_close_relative_to_max(value.detach(), found[None][name].detach(), 1e-4)


def test_priors_that_are_refused_when_they_are_defined():
    with pytest.raises(InputError, match="MineConfig: needs a type that no other prior has; got 'gravity'"):

        @dataclass(frozen=True)
        class MineConfig(PriorConfig):
            type: str = "gravity"

    with pytest.raises(InputError, match="UnnamedConfig: needs a type that no other prior has; got ''"):

        class UnnamedConfig(PriorConfig):
            pass

    with pytest.raises(InputError, match="Warm: 'temperature' is no attribute of particles"):

        class Warm(Prior):
            attributes = ("temperature",)
