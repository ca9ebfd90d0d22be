"""Scores of hand-made images, and reports of hand-made scores."""

import csv
import math

import pytest
import torch

from gsim3d.cli.main import main
from gsim3d.evaluate import scoring
from gsim3d.evaluate.perceptual import fvd
from gsim3d.evaluate.report import markdown, notes, summarize, table, write_csv, write_json
from gsim3d.evaluate.scoring import METRICS, SceneScores, SceneTruth

S, V, H, W, GIVEN = 5, 2, 12, 14, 2


def video(seed=0, n_steps=S, height=H, width=W):
    return torch.rand(n_steps, V, height, width, 3, generator=torch.Generator().manual_seed(seed)) * 0.5


def labels():
    """The left half is background, two columns on the right move; the second view shows nothing of them."""
    labels = torch.ones(S, V, H, W, dtype=torch.uint8)
    labels[..., : W // 2] = 0
    labels[:, 0, :, -2:] = 3
    return labels


def db(error):
    return pytest.approx(-20 * math.log10(error), abs=1e-4)


def test_masks_by_hand():
    truth = video()
    predicted = truth.clone()
    predicted[..., : W // 2, :] += 0.1  # background
    predicted[:, 0, :, -2:] += 0.3
    scores = SceneTruth("a", truth, labels(), None, GIVEN, ("psnr", "psnr_masked", "psnr_body")).score(
        [("model", predicted), ("copy", predicted[GIVEN:])]
    )
    values = scores.values["model"]
    # One view has error 0.3 on 2 of the 7 columns that are no background, the other none at all: 100 dB.
    masked = (-10 * math.log10(0.09 * 2 / 7) + 100) / 2
    assert values["psnr_masked"][4].item() == pytest.approx(masked, abs=1e-4)
    assert values["psnr_body"][0].item() == db(0.3)  # only the view that shows the body
    assert scores.values["copy"]["psnr"][:GIVEN].isnan().all()
    assert torch.equal(scores.values["copy"]["psnr"][GIVEN:], values["psnr"][GIVEN:])
    assert scores.not_measured == {} and scores.clips == {}


def test_invalid_pixels_are_no_error():
    truth, valid = video(), torch.ones(S, V, H, W, dtype=torch.bool)
    valid[..., 11:] = False  # padding
    truth = truth * valid[..., None]
    predicted = truth + 0.1 * valid[..., None]
    predicted[..., 11:, :] = 0.7
    judge = SceneTruth("a", truth, None, valid, GIVEN, ("psnr", "ssim"))
    scores = judge.score([("model", predicted), ("exact", truth + 0.5 * ~valid[..., None])]).values
    assert scores["model"]["psnr"][3].item() == db(0.1)
    assert scores["exact"]["psnr"][3].item() == 100 and scores["exact"]["ssim"][3].item() == pytest.approx(1)


def test_metrics_that_do_not_apply_are_reported(monkeypatch):
    judge = SceneTruth("ball/3", video(height=10), None, None, GIVEN, tuple(METRICS))
    assert judge.metrics == ["psnr"]
    assert judge.not_measured == {
        "psnr_masked": "ball/3 has no segmentation",
        "psnr_body": "ball/3 has no segmentation",
        "psnr_ground": "ball/3 has no segmentation",
        "psnr_ring": "ball/3 has no segmentation",
        "ssim": "ball/3 has images of 14x10 pixels; at least 11 are required",
        "lpips_alex": "ball/3 has images of 14x10 pixels; at least 31 are required",
        "lpips_vgg": "ball/3 has images of 14x10 pixels; at least 16 are required",
        "fvd": "10 predicted steps are required; ball/3 has 3",
    }
    summary = summarize([judge.score([("model", video(height=10))])], {"psnr": "not wanted"})
    assert "future.psnr" not in summary and len(notes(summary)) == len(METRICS)
    assert "PSNR masked: not measured: ball/3 has no segmentation" in table(summary)
    assert "FVD: not measured: 10 predicted steps are required" in markdown(summary, "data")


@pytest.fixture
def cheap_features(monkeypatch):
    """Instead of I3D: the mean colour of the first and the last frame of a clip."""
    monkeypatch.setattr(fvd, "clip_features", lambda clips: clips[:, [0, -1]].mean((2, 3)).flatten(1).double())


def test_help_names_every_metric(capsys):
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    text = capsys.readouterr().out
    assert all(metric in text.split("Metrics:")[1] for metric in METRICS)


def test_fvd_compares_the_predicted_steps_of_all_scenes_and_views(cheap_features):
    videos = [video(seed, n_steps=GIVEN + 10) for seed in range(3)]
    scores = []
    for i, truth in enumerate(videos):
        predicted = truth + 0.1
        predicted[:GIVEN] = 9  # given steps do not count
        scores.append(
            SceneTruth(f"{i}", truth, None, None, GIVEN, ("fvd",)).score(
                [("model", predicted), ("copy", truth[GIVEN:])]
            )
        )
    assert scores[0].clips["truth"].shape == (V, 6)
    assert torch.equal(scores[1].clips["truth"], fvd.clip_features(videos[1][GIVEN:].transpose(0, 1)))
    summary = summarize(scores)
    # A shift of 0.1 in each of 6 features and no other difference.
    assert summary["future.fvd"] == pytest.approx(6 * 0.1**2, rel=1e-4) and summary["n_clips"] == 6
    assert summary["copy.future.fvd"] == pytest.approx(0, abs=1e-12)
    assert notes(summary) == ["FVD: 6 clips; with fewer than 256 it is biased and noisy"]
    one = SceneTruth("a", videos[0][:, :1], None, None, GIVEN, ("fvd",)).score([("model", videos[0][:, :1])])
    assert "at least 2 clips" in summarize([one])["not_measured"]["fvd"]


def test_lpips_is_measured_with_both_networks(monkeypatch):
    called = []
    monkeypatch.setattr(
        scoring.lpips, "lpips", lambda a, b, network: called.append(network) or (a - b).abs().mean((1, 2, 3)).double()
    )
    truth = video(height=32, width=32)
    scores = SceneTruth("a", truth, None, None, GIVEN, ("lpips_alex", "lpips_vgg")).score([("model", truth + 0.25)])
    assert called == ["alex", "vgg"] * S
    assert scores.values["model"]["lpips_vgg"].tolist() == pytest.approx([0.25] * S)


def scores_of(scene, by_method):
    values = {m: {"psnr": torch.tensor(v, dtype=torch.float64)} for m, v in by_method.items()}
    return SceneScores(scene, 1, 3, values, {}, {})


@pytest.fixture
def two_scenes():
    nan = math.nan
    return [
        scores_of("a", {"model": [9.0, 10.0, 20.0], "other": [nan, 1.0, nan]}),
        scores_of("b", {"model": [9.0, 14.0, 22.0], "other": [nan, 3.0, nan]}),
    ]


def test_means_and_deviations_by_hand(two_scenes, tmp_path):
    summary = summarize(two_scenes)
    assert summary["by_step"]["psnr"] == [9, 12, 21]
    assert summary["by_step_std"]["psnr"] == pytest.approx([0, math.sqrt(8), math.sqrt(2)])
    assert summary["future.psnr"] == 16.5 and summary["past.psnr"] == 9 and summary["past_std.psnr"] == 0
    assert summary["future_std.psnr"] == pytest.approx((math.sqrt(8) + math.sqrt(2)) / 2)
    assert summary["by_step"]["other.psnr"] == [None, 2, None] and summary["other.future.psnr"] == 2
    of_b = {"past.psnr": 9, "future.psnr": 18, "future_late.psnr": 22, "other.future.psnr": 3}
    assert summary["scenes"]["b"] == {**of_b, "other.future_late.psnr": None}
    write_json(tmp_path / "m.json", summary)  # no NaN in it


def test_markdown_has_the_rows_of_the_paper(two_scenes):
    lines = markdown(summarize(two_scenes), "elastic").splitlines()
    assert lines[0] == "| Dataset | Method | PSNR (↑) |"
    assert lines[2] == "| elastic | model (1-2) | 16.50 ± 2.12 |"
    assert lines[3] == "| elastic | other (1-2) | 2.00 ± 1.41 |"
    assert "| given steps | model | 9.00 |" in lines and "| second half | model | 21.00 |" in lines
    assert not any(line.startswith("| given steps | other") for line in lines)


def test_csv_has_a_row_for_each_scene_method_and_step(two_scenes, tmp_path):
    write_csv(tmp_path / "m.csv", two_scenes)
    rows = list(csv.DictReader((tmp_path / "m.csv").open()))
    assert list(rows[0]) == ["scene", "method", "step", "part", "psnr"]
    assert len(rows) == 2 * (3 + 2)
    assert rows[0] == {"scene": "a", "method": "model", "step": "0", "part": "given", "psnr": "9.0"}
    assert rows[-1] == {"scene": "b", "method": "other", "step": "2", "part": "predicted", "psnr": ""}
    assert [p.name for p in tmp_path.iterdir()] == ["m.csv"]
