"""Samples of a subset of particles: which they are, and gradients."""

import dataclasses

import pytest
import torch

from gsim3d.priors import padding
from gsim3d.priors.padding import SAMPLES, PaddedClouds, Samples, Subset
from gsim3d.state import DYNAMIC, FROZEN
from gsim3d.testing.invariances import random_order, reordered
from tests.asserts import assert_same_bits
from tests.cuda_graph import captured
from tests.dynamics.scenes import TINY, batch, make_history

pytestmark = pytest.mark.usefixtures("one_thread")


class Members:
    """What samples read of a subset."""

    def __init__(self, positions, known, is_movable=True):
        self.positions, self.known, self.is_movable = positions, known, is_movable


def subset_of(history, clouds=(0, 1), activity=DYNAMIC):
    return Subset(PaddedClouds(history, list(clouds), TINY.grid_size), history, activity)


def two_scenes(device="cpu", dtype=torch.float32):
    """More movable particles than samples, and fewer, in clouds of more rows than samples; some are outside."""
    history = batch([make_history((2000,), dtype=dtype), make_history((1100,), seed=1, frozen_share=0.5, dtype=dtype)])
    history.means[::50] = -1.0
    return history.to(device)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_samples_do_not_depend_on_the_order_of_rows(dtype, device):
    history = two_scenes(device, dtype)
    subset, other = subset_of(history), subset_of(reordered(history, random_order(history)))
    one, two = Samples(subset), Samples(other)
    assert one.known.sum(1).tolist() == [SAMPLES, int(one.n[1])] and one.n[1] < SAMPLES < one.n[0]
    assert_same_bits(two.n, one.n)
    assert_same_bits(two.positions[0], one.positions[0])
    assert_same_bits(two.mean[0], one.mean[0])
    assert_same_bits(two.take(other.positions**2)[0], one.take(subset.positions**2)[0])
    assert len(one.take(subset.rows[:, :, None])[0].unique()) == SAMPLES
    for samples, of in ((one, subset), (two, other)):  # all of fewer members, in the order of rows
        assert_same_bits(samples.positions[1][: one.n[1]], of.positions[1][of.known[1]])


def test_samples_of_frozen_particles_are_in_the_order_of_rows(device):
    history = two_scenes(device)
    subset = subset_of(dataclasses.replace(history, activity=FROZEN - history.activity), activity=FROZEN)
    members, samples = subset.positions[0][subset.known[0]], Samples(subset)
    assert len(members) > SAMPLES
    assert_same_bits(samples.positions[0], members[torch.arange(SAMPLES, device=device) * len(members) // SAMPLES])


def test_samples_of_a_scene_are_those_that_it_has_alone(device):
    history = batch([make_history((n,), seed=n, frozen_share=0.0) for n in (1025, 7, 3000)]).to(device)
    history.means[1025:1032] = torch.nan  # a scene without members
    together, values = Samples(subset_of(history, (0, 1, 2))), torch.rand(3, 3000, 2, device=device)
    for q in range(3):
        alone, n = Samples(subset_of(history, (q,))), history.clouds.count(q)
        for name in ("n", "known", "positions", "mean"):
            assert_same_bits(getattr(alone, name)[0], getattr(together, name)[q])
        assert_same_bits(alone.take(values[q : q + 1, :n])[0], together.take(values)[q])
    assert together.n.tolist() == [1025, 0, 3000]


def test_samples_are_everywhere():
    """The mean of a half of the body is that of its samples, up to the noise of even ones."""
    subset = subset_of(two_scenes())
    members, samples = subset.positions[0][subset.known[0]], Samples(subset).positions[0]
    for axis in range(3):
        halves = (x[x[:, axis] > members[:, axis].mean()].mean(0) for x in (members, samples))
        assert torch.dist(*halves) < 0.01


@pytest.mark.parametrize("is_movable", [True, False])
@pytest.mark.parametrize("n", [0, 5, 8, 20])
def test_gradient_of_samples(n, is_movable, monkeypatch):
    monkeypatch.setattr(padding, "SAMPLES", 8)
    g = torch.Generator().manual_seed(n)
    positions, values = (torch.rand(2, 24, 3, dtype=torch.float64, generator=g) for _ in range(2))
    known = torch.rand(2, 24, generator=g).argsort(1) < torch.tensor([[n], [9]])
    samples = Samples(Members(torch.where(known[:, :, None], positions, 0), known, is_movable))
    assert torch.autograd.gradcheck(lambda x: samples.take(x) ** 2, values.requires_grad_())


def test_samples_in_a_graph(device):
    subset = subset_of(two_scenes(device))

    def sampled(positions, known):
        samples = Samples(Members(positions, known))
        return samples.positions, samples.mean, samples.take(positions**2)

    given = subset.positions, subset.known
    if device.type == "cpu":
        found = torch.compile(sampled, fullgraph=True, backend="aot_eager")(*given)
    else:
        graph, found = captured(lambda: sampled(*given))
        graph.replay()
    for a, b in zip(found, sampled(*given), strict=True):
        assert_same_bits(a, b)
