"""Segmentation of particles into bodies."""

import dataclasses

import pytest
import torch

from gsim3d.effects.edits import Duplicate, Move
from gsim3d.priors import SegmentationConfig
from gsim3d.priors.padding import SAMPLES
from gsim3d.state import DYNAMIC, FROZEN, with_attribute
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import batch, make_dynamics, make_history
from tests.priors.scenes import context, windows, with_priors
from tests.priors.test_gravity import CELL, FLYING

pytestmark = pytest.mark.usefixtures("one_thread")

SEGMENTED = with_priors(FLYING, SegmentationConfig())
MIN_SHARE, NEIGHBORS = SegmentationConfig().min_share, SegmentationConfig().neighbors


def bodies(history):
    """Center of each particle's body [N, 3]."""
    return context(dataclasses.replace(history, body=None), SegmentationConfig(), grid_size=CELL).history.body


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def shell(radius, middle, n, seed=0):
    """Points [n, 3] on a sphere with the spacing of encoded pixels; some have an error of 1 cm."""
    k = torch.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, 2.399963 * k
    at = torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], 1)
    return radius * at + torch.tensor(middle) + 0.005 * torch.randn(n, 3, generator=generator(seed))


def tube(radius, thickness, middle, n, seed=0):
    """Points [n, 3] on a torus."""
    a, b = 6.2832 * torch.rand(2, n, generator=generator(seed))
    ring = radius + thickness * b.cos()
    return torch.stack([ring * a.cos(), ring * a.sin(), thickness * b.sin()], 1) + torch.tensor(middle)


def scene(*parts, seed=0):
    """A scene of one step with the particles of ``parts`` in random order, and the part of each (int64)."""
    places = torch.cat(parts)
    part = torch.cat([torch.full((len(x),), k) for k, x in enumerate(parts)])
    order = torch.randperm(len(places), generator=generator(seed))
    history = make_history((len(places),), seed=seed, frozen_share=0.0)
    return dataclasses.replace(history, means=places[order], origin=torch.zeros(1, 3).double()), part[order]


def separated(history):
    """Centers of bodies, and the index of the body of each particle."""
    return bodies(history).unique(dim=0, return_inverse=True)


def test_gap_separates_bodies():
    """A gap of 6 cm at a spacing of 2 cm."""
    history, part = scene(shell(0.2, (1.0, 1.0, 1.0), 900), shell(0.15, (1.41, 1.0, 1.0), 500, seed=1))
    middles, body = separated(history)
    assert len(middles) == 2
    for k in range(2):
        assert (body[part == k] == body[part == k][0]).all()
        assert (middles[body[part == k][0]] - history.means[part == k].mean(0)).norm() < 0.02


def test_body_with_hole():
    middles, _ = separated(scene(tube(0.22, 0.07, (1.0, 1.0, 1.0), 900))[0])
    assert len(middles) == 1


def test_small_clusters_join_nearest_body():
    g = generator()
    dust, lump = 1.0 + 0.4 * torch.randn(20, 3, generator=g), shell(0.03, (1.35, 1.0, 1.0), int(0.3 * MIN_SHARE * 600))
    middles, body = separated(scene(shell(0.2, (1.0, 1.0, 1.0), 600), lump, dust)[0])
    assert len(middles) == 1 and not body.any()


def test_large_cluster_is_body():
    lump = shell(0.06, (1.4, 1.0, 1.0), int(2 * MIN_SHARE * 600))
    assert len(separated(scene(shell(0.2, (1.0, 1.0, 1.0), 600), lump)[0])[0]) == 2


def test_more_particles_than_samples():
    parts = [shell(0.2, (1.0, 1.0, 1.0), 2 * SAMPLES), shell(0.2, (1.55, 1.0, 1.0), 2 * SAMPLES, seed=1)]
    history, part = scene(*parts)
    middles, body = separated(history)
    assert len(middles) == 2 and (body[part == 0] == body[part == 0][0]).all()
    assert (body[part == 1] != body[part == 0][0]).all()


@pytest.mark.parametrize("n", [1, NEIGHBORS - 1, NEIGHBORS])
def test_few_particles_are_one_body(n):
    history, _ = scene(1.0 + 0.3 * torch.rand(n, 3, generator=generator()))
    assert len(separated(history)[0]) == 1


def test_frozen_particles_are_not_segmented():
    history, _ = scene(shell(0.2, (1.0, 1.0, 1.0), 900))
    activity = history.activity.clone()
    activity[::2] = FROZEN
    found = bodies(dataclasses.replace(history, activity=activity))
    assert_same_bits(found[::2], history.means[::2])
    assert len(found[1::2].unique(dim=0)) == 1
    alone = history.select_rows(activity == DYNAMIC)
    assert_same_bits(found[1::2], bodies(alone))


def test_segmentation_of_no_particles():
    assert bodies(scene(torch.zeros(0, 3))[0]).shape == (0, 3)


def test_batch_equals_single_scenes():
    one, other = scene(shell(0.2, (1.0, 1.0, 1.0), 700))[0], scene(shell(0.2, (1.2, 1.0, 1.0), 900, seed=2))[0]
    together = bodies(batch([one, other]))
    assert_close_relative_to_max(together, torch.cat([bodies(x) for x in (one, other)]), 1e-6)
    assert len(together.unique(dim=0)) == 2


def test_segmentation_moves_with_scene():
    history, _ = scene(shell(0.2, (1.0, 1.0, 1.0), 700), shell(0.2, (1.55, 1.0, 1.0), 700, seed=1))
    far = torch.tensor([300.0, -200.0, 100.0])
    moved = dataclasses.replace(history, means=history.means + far, origin=history.origin + far)
    assert_close_relative_to_max(bodies(moved) - far, bodies(history), 1e-4)


def test_windows_of_segmented_particles_hold_one_body():
    history, part = scene(
        shell(0.2, (1.0, 1.0, 1.0), 300), shell(0.2, (1.55, 1.0, 1.0), 300, seed=1),
        shell(0.2, (1.2, 1.5, 1.1), 300, seed=2),
    )  # fmt: skip
    found = windows(dataclasses.replace(history, body=bodies(history)), 0.3, CELL)
    one = torch.nn.functional.one_hot(part).float()
    (of_rows,) = found.to_particles(found.weights[:, :, : len(one)] @ one[None])
    torch.testing.assert_close(of_rows[0], one, atol=1e-3, rtol=0)


def test_model_with_segmentation_keeps_bodies():
    history, _ = scene(shell(0.2, (1.0, 1.0, 1.0), 300), shell(0.2, (1.55, 1.0, 1.0), 300, seed=1))
    known = make_dynamics(SEGMENTED).begin(history)
    assert_same_bits(known.body, bodies(history))
    assert make_dynamics(FLYING).begin(history).body is None
    later = dataclasses.replace(known, means=torch.rand_like(known.means))
    assert_same_bits(make_dynamics(SEGMENTED).begin(later).body, known.body)


def test_edits_move_bodies():
    history, _ = scene(shell(0.2, (1.0, 1.0, 1.0), 300))
    known = dataclasses.replace(history, body=bodies(history))
    by = torch.tensor([0.5, 0.0, 0.25])
    torch.testing.assert_close(Move("moving", by.tolist()).apply(known, None).body, known.body + by)
    both = Duplicate("moving", by=by.tolist()).apply(known, None)
    assert len(both.body.unique(dim=0)) == 2 and both.n_rows == 2 * history.n_rows


def test_default_body_is_position():
    history, _ = scene(shell(0.2, (1.0, 1.0, 1.0), 30))
    assert_same_bits(with_attribute(history, "body").body, history.means)


def test_on_gpu(devices):
    history, _ = scene(shell(0.2, (1.0, 1.0, 1.0), 700), shell(0.2, (1.55, 1.0, 1.0), 700, seed=1))
    expected, actual = (bodies(history.to(device)).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-6)
