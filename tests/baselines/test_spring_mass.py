"""Spring-mass dynamics against closed forms."""

import math

import pytest
import torch

from gsim3d.baselines.spring_mass import (
    SpringState,
    advance_frame,
    advance_safely,
    bind,
    build_springs,
    connect,
    friction,
    softness,
)
from gsim3d.errors import InputError, NumericalError


def pair(stretch=0.0):
    rest = torch.tensor([[0.0, 0, 0], [1, 0, 0]]).double()
    springs = connect(rest, 1)
    positions = rest + torch.tensor([[-stretch / 2, 0, 0], [stretch / 2, 0, 0]]).double()
    return SpringState(positions, torch.zeros(2, 3).double()), springs


def given(springs, k=100.0, **more):
    n, count = springs.lengths.shape
    stiffness = torch.full((n,), k, dtype=springs.rest.dtype)
    parts = {
        "stiffness": stiffness,
        "factors": torch.ones(count, dtype=springs.rest.dtype),
        "damping": 0.0,
        "grip": 1.0,
    }
    return {"springs": springs, **parts, "ground": None, "gravity": 0.0} | more


def accelerations(state, springs, k=100.0, **more):
    after = advance_frame(state, seconds=1e-3, substeps=1, **given(springs, k, **more))
    return (after.velocities - state.velocities) / 1e-3


def cube(n=60, seed=0):
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return build_springs(points, n_anchors=n, n_neighbors=12, edge=0.01, seed=0)


@torch.no_grad()
def test_two_anchors_swing_with_the_period_of_their_spring():
    state, springs = pair(stretch=0.01)
    period = 2 * math.pi * math.sqrt(1 / (2 * 100.0))
    state = advance_frame(state, seconds=period, substeps=400, power=0.0, **given(springs))
    assert abs((state.positions[1, 0] - state.positions[0, 0]).item() - 1.01) < 1e-4
    for _ in range(10):
        state = advance_frame(state, seconds=2.5 * period, substeps=1000, power=0.0, **given(springs))
        stretch = (state.positions[1, 0] - state.positions[0, 0]).item() - 1
        energy = 50 * stretch**2 + 0.5 * state.velocities.square().sum().item()
        assert abs(energy / (50 * 0.01**2) - 1) < 0.02


def test_strain_stiffens():
    state, springs = pair(stretch=0.21)
    pull = accelerations(state, springs, 7.0)
    assert pull[0, 0].item() == pytest.approx(7 * 0.21 * math.sqrt(1.21), rel=1e-7)
    assert accelerations(*pair()).abs().max() == 0


def test_free_fall_is_exact_and_keeps_the_shape():
    springs = cube()
    started = SpringState(springs.rest, torch.tensor([0.1, 0.2, 0.3]).double().expand(len(springs.rest), 3))
    ended = advance_frame(started, seconds=0.5, substeps=50, **given(springs, gravity=9.8))
    moved = torch.tensor([0.05, 0.1, 0.15 - 9.8 * 0.5 * 0.51 / 2]).double()
    assert (ended.positions - springs.rest - moved).abs().max() < 1e-6


def test_rigid_motions_make_no_force():
    springs = cube()
    angle = torch.tensor(0.7).double()
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]]).double()
    at = springs.rest @ turn.T + 3
    spinning = torch.linalg.cross(torch.tensor([0.1, 0.2, 0.3]).double().expand_as(at), at)
    for velocities in (torch.ones_like(at), spinning):
        assert accelerations(SpringState(at, velocities), springs, 1.0, damping=5.0).abs().max() < 1e-9


def test_ground_stops_and_grips():
    springs = cube()
    started = SpringState(springs.rest, torch.tensor([1.0, 0, -1.0]).double().expand_as(springs.rest))
    ended = advance_frame(started, seconds=0.1, substeps=20, **given(springs, ground=0.3, grip=0.9))
    assert ended.positions[:, 2].min() >= 0.3
    one = pair()[1]
    state = SpringState(torch.tensor([[0.0, 0, 0], [1, 0, 0]]).double(), torch.tensor([[2.0, 0, 0]] * 2).double())
    slid = advance_frame(state, seconds=0.1, substeps=7, **given(one, k=0.0, ground=0.0, gravity=9.8, grip=0.9))
    assert torch.allclose(slid.velocities[:, 0], torch.full((2,), 2 * 0.9**7).double(), rtol=1e-6)


def test_softness():
    soft = softness(torch.tensor(0.0), 256)
    assert (soft[:16] == 1).all() and torch.allclose(soft[16:], 2 - 2 ** (torch.arange(240) / 240), atol=1e-6)
    shorter = softness(torch.tensor(2.0), 256)
    assert (soft.diff() <= 0).all() and (shorter <= soft).all() and shorter.min() >= 0
    assert softness(torch.tensor(0.0), 5).tolist() == [1.0] * 5


def test_friction_is_a_share():
    assert friction(torch.tensor([-9.0, -1.0, 9.0])).tolist() == pytest.approx(
        [0, 1.2 / (1 + math.e) - 0.1, 1], abs=1e-6
    )


def test_binding_moves_as_the_anchors():
    springs, points = cube(), torch.rand(30, 3).double()
    indices, weights = bind(points, springs.rest)
    assert (weights > 0).all() and torch.allclose(weights.sum(1), torch.ones(30).double())
    mean = (weights[..., None] * springs.rest[indices]).sum(1)
    stretched = springs.rest * torch.tensor([2.0, 1, 0.5]) + 1
    assert torch.allclose((weights[..., None] * stretched[indices]).sum(1), mean * torch.tensor([2.0, 1, 0.5]) + 1)


def test_gradients_match_finite_differences():
    springs = cube(n=8)
    v0, q, s = torch.randn(8, 3).double() * 0.1, torch.tensor(-1.0).double(), torch.tensor(0.3).double()

    def frame(kappa, q, s, v0, damping):
        ended = advance_frame(
            SpringState(springs.rest * 1.1, v0), springs, stiffness=10**kappa, factors=softness(s, 7),
            damping=damping, grip=friction(q), seconds=0.05, substeps=4, ground=0.2,
        )  # fmt: skip
        return torch.cat(ended)

    arguments = [torch.full((8,), 1.5).double(), q, s, v0, torch.tensor(0.1).double()]
    torch.autograd.gradcheck(frame, [x.requires_grad_() for x in arguments])


@torch.no_grad()
def test_substeps_grow_until_finite():
    springs = cube()
    springs = connect(springs.rest.float(), 12)
    state = SpringState(springs.rest * 1.5, torch.zeros_like(springs.rest))
    options = {"state": state, "seconds": 1.0, **given(springs, k=1e3)}
    ended, substeps = advance_safely(3, 20, 100, **options)
    assert substeps > 20 and ended.positions.isfinite().all()
    with pytest.raises(NumericalError, match="frame 3"):
        advance_safely(3, 100, 450, **options | given(springs, k=1e9))


def test_rest_lengths_are_exact_far_from_the_origin():
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * 0.1 + torch.tensor([3.0, -2.0, 1.0])
    springs = build_springs(points, n_anchors=300, n_neighbors=20, edge=0.01, seed=0)
    exact = torch.cdist(springs.rest.double(), springs.rest.double()).fill_diagonal_(9).sort(1).values[:, :20]
    assert (springs.lengths - exact).abs().max() < 1e-6
    state = SpringState(springs.rest, torch.zeros_like(springs.rest))
    assert accelerations(state, springs, 1000.0).abs().max() == 0


def test_a_single_voxel_is_refused():
    with pytest.raises(InputError, match="smaller edge"):
        build_springs(torch.zeros(5, 3), n_anchors=4, n_neighbors=2, edge=0.1, seed=0)
