"""Predictions of other models: found by scene, camera and step; what is missing, short or odd is named."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest
import torch

from gsim3d.cli.main import main
from gsim3d.data import Fitting, Scene
from gsim3d.errors import InputError
from gsim3d.evaluate.predictions import Predictions
from gsim3d.evaluate.protocol import score_scene
from gsim3d.io import write_video
from tests.data.made_videos import with_gaps, write_plain
from tests.data.test_video_scenes import write_odd_videos
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

GIVEN, N_STEPS = 2, 6


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes") / "data", 2, n_steps=N_STEPS)


@pytest.fixture
def folder(data, tmp_path):
    """Perfect predictions of cameras 1 and 3 of both scenes, as frames; only what was to be predicted."""
    for scene in sorted((data / "ball").iterdir()):
        for cam in (1, 3):
            target = tmp_path / "other" / "ball" / scene.name / f"cam_{cam}"
            target.mkdir(parents=True)
            for step in range(GIVEN, N_STEPS):
                shutil.copy(scene / f"cam_{cam}" / f"rgb_{step:04d}.png", target / f"frame{step}.png")
    return tmp_path / "other"


def scene_of(data, name="0000"):
    return Scene.open(data / "ball" / name)


def flat_video(path, levels, size=(32, 32)):
    """A video of frames of one colour: red of ``levels``, green 60, blue 200."""
    write_video(path, [np.full((size[1], size[0], 3), (level, 60, 200), np.uint8) for level in levels], 12.0)


def test_frames_are_found_by_scene_camera_and_step(data, folder):
    scene, predictions = scene_of(data, "0001"), Predictions.open(str(folder), data)
    assert predictions.name == "other" and predictions.cameras(scene) == (1, 3)
    images = predictions.images(scene, [3, 1], GIVEN, 3)
    assert torch.equal(images, scene.images([3, 1], range(2, 5)).permute(0, 1, 3, 4, 2))


def test_perfect_predictions_score_perfectly_and_the_copy_beside_them_does_not(data, folder):
    scores = score_scene(
        None, scene_of(data), target_cams=(1, 3), n_encoded=GIVEN, others=[Predictions.open(f"perfect={folder}", data)]
    )
    assert list(scores.values) == ["perfect", "copy"]
    assert scores.values["perfect"]["psnr"][GIVEN:].tolist() == [100.0] * 4
    assert scores.values["perfect"]["psnr"][:GIVEN].isnan().all()
    assert (scores.values["copy"]["psnr_body"][GIVEN:] < 40).all()


def test_predictions_are_fitted_like_their_scene(tmp_path):
    """Odd sizes, a lens, a real background: a prediction that repeats the camera's own frames is perfect."""
    write_odd_videos(tmp_path / "room")
    scene = Scene.open(tmp_path / "room")
    assert scene.recording.real_background and scene.valid([0], [0]) is not None
    same = Predictions.open(f"same={scene.path}", scene.path)
    (scene.path / "states.npz").write_bytes(b"damaged")  # images alone are not measured beside true states
    values = score_scene(None, scene, target_cams=(0, 1, 2), n_encoded=2, n_future=3, others=[same]).values
    for metric, best in (("psnr", 100.0), ("psnr_masked", 100.0), ("ssim", 1.0)):
        assert values["same"][metric][2:].tolist() == pytest.approx([best] * 3, abs=1e-9)
        assert (values["copy"][metric][2:] < 0.99 * best).all()


def test_predictions_are_resized_to_the_model(data, folder):
    scene = Scene.open(data / "ball" / "0000", fitting=Fitting(size=(24, 16)))
    images = Predictions.open(str(folder), data).images(scene, [3], GIVEN, 4)
    assert images.shape == (4, 1, scene.height, scene.width, 3)
    assert torch.equal(images, scene.images([3], range(2, 6)).permute(0, 1, 3, 4, 2))


@pytest.mark.parametrize("n_future, n_frames, first", [(4, 6, 2), (4, 4, 0), (1, 6, 2), (1, 3, 2), (1, 1, 0)])
def test_length_of_a_video_gives_its_start(data, folder, n_future, n_frames, first):
    place = folder / "ball" / "0000"
    shutil.rmtree(place / "cam_1")
    levels = [20 + 30 * k for k in range(n_frames)]
    flat_video(place / "cam_1.mp4", levels)
    predictions = Predictions.open(str(folder), data)
    assert predictions.cameras(scene_of(data)) == (1, 3)
    images = predictions.images(scene_of(data), [1], GIVEN, n_future)
    assert images.shape == (n_future, 1, 32, 32, 3)
    means = images.float().mean((1, 2, 3))
    assert means[:, 0].tolist() == pytest.approx(levels[first : first + n_future], abs=8)  # lossy
    assert means[:, 1:].tolist() == [pytest.approx([60, 200], abs=8)] * n_future


def test_video_of_ambiguous_length_is_refused(data, folder):
    shutil.rmtree(folder / "ball" / "0000" / "cam_1")
    flat_video(folder / "ball" / "0000" / "cam_1.mp4", [9] * 4)  # steps 0 to 3, or 2 to 5?
    with pytest.raises(InputError, match="its first frame may be step 0 or 2"):
        Predictions.open(str(folder), data).images(scene_of(data), [1], GIVEN, 2)


def remove_scene(place):
    shutil.rmtree(place)


def remove_camera(place):
    shutil.rmtree(place / "cam_1")


def remove_step(place):
    (place / "cam_1" / "frame3.png").unlink()


def repeat_step(place):
    shutil.copy(place / "cam_1" / "frame3.png", place / "cam_1" / "again_0003.png")


def resize_step(place):
    cv2.imwrite(str(place / "cam_1" / "frame4.png"), np.zeros((33, 31, 3), np.uint8))


def break_step(place):
    (place / "cam_1" / "frame4.png").write_bytes(b"no image")


def short_video(place):
    remove_camera(place)
    flat_video(place / "cam_1.mp4", [9] * 3)


def long_video(place):
    remove_camera(place)
    flat_video(place / "cam_1.mp4", [9] * 7)


def large_video(place):
    remove_camera(place)
    flat_video(place / "cam_1.mp4", [9] * 6, (34, 32))


def broken_video(place):
    remove_camera(place)
    (place / "cam_1.mp4").write_bytes(b"no video")


def pipe_as_video(place):
    remove_camera(place)
    os.mkfifo(place / "cam_1.mp4")


def uneven_video(place):
    remove_camera(place)
    with_gaps(write_plain(place / "cam_1.mp4", 4, size=(32, 32)), [40, 400, 40])


def cut_video(place):
    remove_camera(place)
    data = write_plain(place / "cam_1.mp4", 6, size=(32, 32)).read_bytes()
    (place / "cam_1.mp4").write_bytes(data[: len(data) // 2])


def float_tiff(place):
    (place / "cam_1" / "frame4.png").unlink()
    cv2.imwrite(str(place / "cam_1" / "frame4.tif"), np.full((32, 32, 3), 0.5, np.float32))


def unscaled_steps(place):
    for file in (place / "cam_1").iterdir():
        cv2.imwrite(str(file), np.arange(32 * 32 * 3).reshape(32, 32, 3).astype(np.uint8) % 2)


def endless_png(place):
    file = place / "cam_1" / "frame4.png"
    data = bytearray(file.read_bytes())
    data[16:20] = (2**31 - 1).to_bytes(4, "big")
    file.write_bytes(data)


def cut_png(place):
    file = place / "cam_1" / "frame4.png"
    file.write_bytes(file.read_bytes()[:-20])


def folder_as_step(place):
    (place / "cam_1" / "frame4.png").unlink()
    (place / "cam_1" / "frame4.png").mkdir()


def two_dozen_digits(place):
    (place / "cam_1" / "frame4.png").rename(place / "cam_1" / ("frame" + "4" * 200 + ".png"))


def test_sixteen_bits_and_alpha_are_read_like_recordings(data, folder):
    place = folder / "ball" / "0000" / "cam_1"
    before = Predictions.open(str(folder), data).images(scene_of(data), [1], GIVEN, 4)
    for number, file in enumerate(sorted(place.iterdir())):
        image = cv2.imread(str(file))
        if number % 2:
            cv2.imwrite(str(file), image.astype(np.uint16) * 257)
        else:
            noise = np.full_like(image, 200)
            hidden = (image.max(-1) == 0)[..., None]
            cv2.imwrite(str(file), np.concatenate([np.where(hidden, noise, image), 255 * ~hidden], 2).astype(np.uint8))
    assert torch.equal(Predictions.open(str(folder), data).images(scene_of(data), [1], GIVEN, 4), before)


@pytest.mark.parametrize(
    "damage, message",
    [
        (remove_scene, r"other/ball/0001 is missing: predictions of .*data/ball/0001 are expected there"),
        (remove_camera, r"other/ball/0001/cam_1 is missing: a folder of frames, or a video cam_1.mp4"),
        (remove_step, r"cam_1: step 3 is missing \(1 of 4 are\); .* here 2 to 5"),
        (repeat_step, r"again_0003.png and frame3.png are both step 3"),
        (resize_step, r"frame4.png .*has 31x33 pixels, its camera 32x32"),
        (break_step, r"frame4.png .*cannot be decoded"),
        (short_video, r"cam_1.mp4 has 3 frames; .* must have 6 .* or without the input steps 4"),
        (long_video, r"cam_1.mp4 has more than 6 frames"),
        (large_video, r"cam_1.mp4 .*has 34x32 pixels, its camera 32x32"),
        (pipe_as_video, r"cam_1 is missing: a folder of frames, or a video cam_1.mp4"),
        (uneven_video, r"cam_1.mp4: its 4 frames are 40 to 400 ms apart"),
        (cut_video, r"cam_1.mp4 .*cannot be (opened|decoded)"),
        (float_tiff, r"frame4.tif .*must have 8 or 16 bits per channel; got float32"),
        (unscaled_steps, r"cam_1: colours are 0 and 1 of 255"),
        (endless_png, r"frame4.png .*has 2147483647x32 pixels, its camera 32x32"),
        (cut_png, r"frame4.png .*cannot be decoded"),
        (folder_as_step, r"frame4.png .*is missing"),
        (two_dozen_digits, r"cam_1: step 4 is missing"),
        (broken_video, r"cam_1.mp4 .*cannot be opened: it is damaged, truncated or not a video"),
    ],
)
def test_what_does_not_fit_is_named(data, folder, damage, message, capfd):
    damage(folder / "ball" / "0001")
    with pytest.raises(InputError, match=message):
        Predictions.open(str(folder), data).images(scene_of(data, "0001"), [1], GIVEN, 4)


def test_folders_and_names_are_checked(data, folder, tmp_path):
    with pytest.raises(InputError, match="nowhere is not a folder"):
        Predictions.open("x=nowhere", data)
    with pytest.raises(InputError, match="'copy' is reserved"):
        Predictions.open(f"copy={folder}", data)
    (tmp_path / "other" / "ball" / "0000" / "cam_9").mkdir()
    with pytest.raises(InputError, match="predictions of camera 9, but .* has 5 cameras"):
        Predictions.open(str(folder), data).cameras(scene_of(data))
    empty = tmp_path / "empty" / "ball" / "0000"
    empty.mkdir(parents=True)
    with pytest.raises(InputError, match="neither a folder nor a video"):
        Predictions.open(str(tmp_path / "empty"), data).cameras(scene_of(data))


def test_a_single_scene_is_its_own_data_set(data, folder):
    root = data / "ball" / "0000"
    predictions = Predictions.open(str(folder / "ball" / "0000"), root)
    assert predictions.images(Scene.open(root), [1], GIVEN, 1).shape == (1, 1, 32, 32, 3)


@pytest.fixture
def no_weights(monkeypatch, tmp_path):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path / "cache"))


def evaluate(capsys, *arguments):
    code = main(["evaluate", *map(str, arguments)])
    output = capsys.readouterr()
    return code, output.out, output.err


def test_the_command_scores_them_without_a_checkpoint(data, folder, capsys, no_weights):
    out = folder / "metrics.json"
    code, text, _ = evaluate(capsys, "--predictions", folder, data, "--given", 2, "--scenes", "all")
    assert (
        code == 0 and "other, predicted steps" in text and "LPIPS vgg: not measured: run gsim3d weights lpips" in text
    )
    summary = json.loads(out.read_text())
    assert summary["methods"] == ["other", "copy"] and summary["other.future.psnr"] == 100.0
    assert summary["not_measured"]["fvd"] == "run gsim3d weights fvd"
    assert summary["checkpoint"] is None and summary["predictions"] == {"other": str(folder)}
    assert summary["cameras"]["ball/0001"] == {"context": None, "target": [1, 3]}
    assert sorted(p.name for p in folder.glob("metrics.*")) == [f"metrics.{e}" for e in ("csv", "json", "md", "png")]


def test_scenes_of_the_same_name_stay_apart(data, folder, tmp_path, capsys, no_weights):
    both, others = tmp_path / "both", tmp_path / "others"
    for part in ("a", "b"):
        shutil.copytree(data, both / part)
        shutil.copytree(folder, others / part)
    arguments = ["--predictions", others, both, "--given", 2, "--scenes", "all", "--metrics", "psnr"]
    assert evaluate(capsys, *arguments, "--out", tmp_path / "m.json")[0] == 0
    assert set(json.loads((tmp_path / "m.json").read_text())["scenes"]) == {
        f"{p}/ball/000{i}" for p in "ab" for i in (0, 1)
    }


def test_a_report_is_not_written_where_predictions_do_not_fit(data, folder, capsys, no_weights):
    remove_step(folder / "ball" / "0001")
    code, _, err = evaluate(capsys, "--predictions", folder, data, "--given", 2, "--scenes", "all")
    assert code == 2 and "step 3 is missing" in err and len(err.splitlines()) == 1  # found before anything is scored
    assert not list(folder.glob("metrics.*"))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["{data}"], "nothing to evaluate"),
        (["{data}", "--predictions", "{other}"], "--given: the number of input steps"),
        (["{data}", "--predictions", "{other}", "--given", "0"], "at least 1"),
        (["{data}", "--predictions", "{other}", "--given", "6"], "only 0 after the input"),
        (["{data}", "--predictions", "{other}", "--predictions", "{other}", "--given", "2"], "names must be unique"),
        (["{data}", "--predictions", "{other}", "--given", "2", "--cameras", "7"], "camera 7 does not exist"),
        (["{data}", "--predictions", "{other}", "--given", "2", "--metrics", "speed"], "'speed' does not exist"),
        (["{data}", "--predictions", "{other}", "--given", "2", "--metrics", "fvd"], "run gsim3d weights fvd"),
        (["{data}", "--predictions", "{other}", "--given", "2", "--out", "numbers.txt"], "must end in .json"),
        (["{data}", "{data}", "--given", "2"], "with a CHECKPOINT"),
    ],
)
def test_bad_options_are_named(data, folder, capsys, no_weights, arguments, message):
    code, _, err = evaluate(capsys, *(argument.format(data=data, other=folder) for argument in arguments))
    assert code == 2 and message in err and len(err.splitlines()) == 1
