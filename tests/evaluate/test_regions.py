"""Parts of the mask by hand: ground, the ring around bodies, exact parts, shares, and what the future adds."""

import math

import cv2
import numpy as np
import pytest
import torch

from gsim3d.evaluate.report import markdown, notes, summarize, table
from gsim3d.evaluate.scoring import SceneScores, SceneTruth, ring_around_bodies

GIVEN, S, H, W = 2, 5, 12, 20
METRICS = ("psnr", "psnr_masked", "psnr_body", "psnr_ground", "psnr_ring")


def disc_labels(radius, size=64):
    """A disc that moves on ground, of which the outer pixels are background."""
    labels = np.ones((size, size), np.uint8)
    cv2.circle(labels, (size // 2, size // 2), radius, 3, -1)
    labels[:4] = 0
    return torch.from_numpy(labels)


def test_the_ring_is_a_share_of_the_diameter_of_its_body():
    for radius in (5, 10, 16):
        labels = disc_labels(radius)
        ring = ring_around_bodies(labels)
        y, x = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
        distance = torch.hypot(y - 32.0, x - 32.0)
        assert not ring[labels != 1].any()
        assert ring[(distance > radius + 1) & (distance < 1.6 * radius - 1) & (labels == 1)].all()
        assert not ring[distance > 1.6 * radius + 2].any()


def test_every_body_has_a_ring_of_its_own_size():
    large, small = disc_labels(10), disc_labels(3)
    both = torch.cat([large, small], 1)
    ring = ring_around_bodies(both.expand(2, 3, *both.shape))
    assert ring.shape == (2, 3, 64, 128) and (ring == ring[0, 0]).all()
    assert torch.equal(ring[1, 2], torch.cat([ring_around_bodies(large), ring_around_bodies(small)], 1))
    assert not ring_around_bodies(torch.ones(8, 8, dtype=torch.uint8)).any()  # without a body
    assert not ring_around_bodies(torch.full((8, 8), 3, dtype=torch.uint8)).any()  # without ground


def labels():
    """Five columns of background, five that move, ten of ground."""
    labels = torch.ones(S, 1, H, W, dtype=torch.uint8)
    labels[..., :5], labels[..., 5:10] = 0, 3
    return labels


def scored(body=0.2, ground=0.1, given=0.05):
    """Given steps have error ``given`` everywhere, predicted ones those of their parts."""
    truth = torch.full((S, 1, H, W, 3), 0.5)
    predicted = truth + ground * (labels() == 1)[..., None] + body * (labels() == 3)[..., None]
    predicted[:GIVEN] = 0.5 + given
    return SceneTruth("a", truth, labels(), None, GIVEN, METRICS).score(
        [("model", predicted), ("constant", predicted[GIVEN:]), ("copy", truth[GIVEN:])]
    )


def db(mse):
    return pytest.approx(-10 * math.log10(mse), abs=1e-4)


def test_regions_by_hand():
    scores = scored()
    values = scores.values
    assert list(values) == ["model", "constant", "copy", "perfect_ground", "perfect_body"]
    assert values["model"]["psnr_ground"][3].item() == values["model"]["psnr_ring"][3].item() == db(0.1**2)
    assert values["model"]["psnr_body"][3].item() == db(0.2**2)
    assert values["perfect_ground"]["psnr_masked"][3].item() == db(0.2**2 / 3)
    assert values["perfect_body"]["psnr_masked"][3].item() == db(0.1**2 * 2 / 3)
    assert list(values["perfect_body"]) == ["psnr_masked"]
    assert values["perfect_body"]["psnr_masked"][:GIVEN].isnan().all()
    assert scores.body_share.tolist() == pytest.approx([1 / 3] * S)


def test_the_report_says_how_much_the_future_adds():
    summary = summarize([scored(), scored(given=0.1)])
    masked = (0.2**2 + 2 * 0.1**2) / 3
    assert summary["scenes"]["a"]["added_mse.masked"] == pytest.approx(masked - 0.1**2)
    one = summarize([scored()])
    assert one["added_mse.masked"] == pytest.approx(masked - 0.05**2)
    assert one["added_mse.body"] == pytest.approx(0.2**2 - 0.05**2) and one["body_share"] == pytest.approx(1 / 3)
    assert one["by_step"]["body_share"] == pytest.approx([1 / 3] * S)
    assert one["perfect_ground.future.psnr_masked"] == db(0.2**2 / 3) and "perfect_ground.future.psnr" not in one
    for text in (table(one), markdown(one, "data")):
        assert (
            "Bodies: 33.3% of the foreground." in text
            and "predicted minus given steps" in text
            and "perfect_body" in text
        )


def test_unknown_parts_are_not_reported():
    truth = torch.full((S, 1, H, W, 3), 0.5)
    bare = SceneTruth("b", truth, None, None, GIVEN, METRICS).score([("constant", truth[GIVEN:])])
    summary = summarize([bare])
    assert bare.body_share is None and list(bare.values) == ["constant"]
    assert "body_share" not in summary and "minus given steps" not in table(summary)
    mixed = summarize([scored(), bare])  # the second scene has no labels
    assert "psnr_masked" in mixed["not_measured"] and "body_share" in mixed
    assert mixed["n_scenes_of"] == {name: 1 for name in mixed["methods"] if name != "constant"}
    assert "copy: mean over 1 of 2 scenes" in notes(mixed)


def test_bodies_alone_have_no_ground():
    truth, moving = torch.full((S, 1, H, W, 3), 0.5), torch.full((S, 1, H, W), 3, dtype=torch.uint8)
    scores = SceneTruth("a", truth, moving, None, GIVEN, METRICS).score([("model", truth + 0.1)])
    summary = summarize([scores])
    assert summary["future.psnr_ground"] is None and summary["future.psnr_ring"] is None
    assert isinstance(scores, SceneScores) and "added_mse.ground" not in summary and summary["body_share"] == 1
