"""Videos of real cameras: videos, odd sizes, lenses, backgrounds; the whole way through train, simulate, evaluate."""

import dataclasses
import json
import os
import shutil

import cv2
import numpy as np
import pytest
import torch

from gsim3d.cli.main import main
from gsim3d.data import Scene, make_frames
from gsim3d.data.check import check_scene
from gsim3d.data.lenses import Lens, Undistorter
from gsim3d.errors import InputError
from gsim3d.io import write_video
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.samples import draw_batch
from tests.data.made_scenes import (
    FPS,
    N_CAMS,
    N_STEPS,
    draw,
    edit_json,
    make_scene,
    save,
    write_transforms,
    write_videos,
)
from tests.data.made_videos import write_plain

LENS = [-0.25, 0.08, 0.004, -0.003, 0.02]
SIZES = [(45, 30), (48, 32), (41, 27)]
N_LONG = 12


def distorted(image: np.ndarray, K: np.ndarray, lens) -> np.ndarray:
    """What a camera with this lens sees of a pinhole image: for each of its pixels, where the ray meets the pinhole."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float64)
    own = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    points = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), own, np.array(lens), P=own)
    position = points.reshape(height, width, 2).astype(np.float32)
    return cv2.remap(image, position[..., 0], position[..., 1], cv2.INTER_LINEAR)


def write_odd_videos(folder, n_steps=N_LONG, lens=LENS, background=True):
    """Three cameras of different odd sizes, with a lens and a textured room behind a ball that crosses the view.

    Returns what a pinhole would see, [T][V] -> (rgb, labels), and the intrinsics.
    """
    made = make_scene(n_steps=n_steps)
    room = np.random.default_rng(0).integers(60, 160, (32, 48, 3), dtype=np.uint8)
    room = cv2.GaussianBlur(room, (0, 0), 2)
    truth, cameras = [], []
    for step in range(n_steps):
        center = np.array([0.9 * np.cos(2 * np.pi * step / n_steps), 0.9 * np.sin(2 * np.pi * step / n_steps), 0.5])
        views = []
        for cam, (width, height) in enumerate(SIZES):
            viewmat, K = made.viewmats[0, cam], made.Ks[0, cam]
            rgb, labels = draw(viewmat, K, width, height, center)
            if background:
                rgb[labels != 3] = room[:height, :width][labels != 3]
            save(folder / f"cam_{cam}" / f"{step}.png", rgb if lens is None else distorted(rgb, K, lens))
            views.append((rgb, labels))
        truth.append(views)
    for cam, size in enumerate(SIZES):
        viewmat = made.viewmats[0, cam]
        camera = {"name": f"cam_{cam}", "size": size, "K": made.Ks[0, cam].tolist()}
        camera |= {"R": viewmat[:3, :3].tolist(), "T": viewmat[:3, 3].tolist()}
        cameras.append(camera if lens is None else {**camera, "distortion": lens})
    content = {"cameras": cameras, "fps": FPS, "near": 1.0, "far": 5.0}
    (folder / "cameras.json").write_text(json.dumps(content))
    return truth


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    folder = tmp_path_factory.mktemp("odd") / "room"
    return folder, write_odd_videos(folder)


def test_odd_sizes_are_padded_and_padding_is_not_valid(odd):
    folder, _ = odd
    scene = Scene.open(folder)
    assert (scene.width, scene.height) == (48, 32)
    valid = scene.valid(range(3), [0, 5])
    video, labels = scene.recorded_images(range(3), [0, 5]), scene.segmentation(range(3), [0, 5])
    for cam, (width, height) in enumerate(SIZES):
        outside = torch.ones(32, 48, dtype=torch.bool)
        outside[:height, :width] = False
        assert not valid[:, cam, outside].any() and valid[:, cam, :height, :width].float().mean() > 0.8
        assert not video[:, cam, :, outside].any() and not labels[:, cam, outside].any()
    cameras = scene.cameras_at(range(3), [0])
    Ks = np.array([camera["K"] for camera in json.loads((folder / "cameras.json").read_text())["cameras"]])
    np.testing.assert_allclose(cameras.Ks, Ks, rtol=1e-6)
    frames = make_frames([scene], [[0, 1, 2]], [[3]])
    assert torch.equal(frames.valid, valid[0]) and not (frames.masks & ~frames.valid).any()


def test_videos_are_undistorted(odd):
    """The undistorted video is what a pinhole sees, up to the blur of two interpolations."""
    folder, truth = odd
    scene = Scene.open(folder)
    video, valid = scene.recorded_images(range(3), range(N_LONG)), scene.valid(range(3), [0])[0]
    with_lens = []
    for cam, (width, height) in enumerate(SIZES):
        seen = valid[cam, :height, :width].numpy()
        for step in range(N_LONG):
            wanted = truth[step][cam][0].astype(float)
            got = video[step, cam, :, :height, :width].permute(1, 2, 0).numpy().astype(float)
            assert np.abs(got - wanted)[seen].mean() < 6
            stored = cv2.imread(str(folder / f"cam_{cam}" / f"{step}.png"))[..., ::-1].astype(float)
            with_lens.append(np.abs(stored - wanted)[seen].mean() > 1.2 * np.abs(got - wanted)[seen].mean())
    assert np.mean(with_lens) > 0.9


def test_undistorter_samples_the_distorted_rays_of_videos():
    """An image that holds its own coordinates shows where each pixel of the result was taken."""
    K = np.array([[200.0, 0, 101.5], [0, 210.0, 76.0], [0, 0, 1]])
    y, x = np.mgrid[:160, :200].astype(np.float32)
    taken = Undistorter(Lens(np.array(LENS)), (200, 160))(np.stack([x, y], -1), K)
    for column, row in ((20, 15), (101, 76), (180, 30), (60, 140)):
        ray = np.linalg.inv(K) @ [column + 0.5, row + 0.5, 1]  # through the centre of the pixel
        in_lens = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), K, np.array(LENS))[0].ravel()
        assert np.abs(taken[row, column] + 0.5 - in_lens).max() < 0.03  # OpenCV interpolates in steps of 1/32
        assert np.abs(in_lens - [column + 0.5, row + 0.5]).max() > 0.1 or (column, row) == (101, 76)


def test_videos_background_is_subtracted_and_painted_black(odd):
    folder, truth = odd
    scene = Scene.open(folder)
    labels, images = scene.segmentation(range(3), range(N_LONG)), scene.images(range(3), range(N_LONG))
    assert set(labels.unique().tolist()) == {0, 3}
    assert not images.permute(0, 1, 3, 4, 2)[labels == 0].any()
    hits, joint = 0, 0
    for step in range(N_LONG):
        for cam, (width, height) in enumerate(SIZES):
            ball = truth[step][cam][1] == 3
            found = labels[step, cam, :height, :width].numpy() == 3
            hits, joint = hits + (ball & found).sum(), joint + (ball | found).sum()
    assert hits / joint > 0.6
    edit_json(folder / "cameras.json", lambda content: content.update(masks="none"))
    try:
        plain = Scene.open(folder)
        assert not plain.has_segmentation() and plain.images([0], [0]).float().mean() > 40
        frames = make_frames([plain], [[0, 2]], [[1]], masked=False)
        assert frames.dynamic is None and torch.equal(frames.masks, frames.valid)
    finally:
        edit_json(folder / "cameras.json", lambda content: content.pop("masks"))


def test_videos_mask_folders_are_read(tmp_path):
    made = make_scene()
    folder = write_videos(tmp_path, made)
    (folder / "labels").rename(folder / "masks")
    for file in (folder / "masks").rglob("*.png"):
        mask = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) == 3
        cv2.imwrite(str(file), mask.astype(np.uint8) * 255)
    scene = Scene.open(folder)
    np.testing.assert_array_equal(scene.segmentation(range(3), range(4)), np.where(made.labels == 3, 3, 0))


def write_encoded(folder, made, fps=FPS):
    """The same cameras, one .mp4 each, 96x64 (video coding blurs single pixels)."""
    write_videos(folder, made, stride=1)
    for cam in range(made.rgb.shape[1]):
        write_video(folder / f"video_{cam}.mp4", list(made.rgb[:, cam]), fps)

    def edit(content):
        content.pop("fps")
        for cam, camera in enumerate(content["cameras"]):
            camera["name"] = f"video_{cam}"

    edit_json(folder / "cameras.json", edit)
    for cam in range(made.rgb.shape[1]):
        (folder / "labels" / f"cam_{cam}").rename(folder / "labels" / f"video_{cam}")
    return folder


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    made = make_scene(width=96, height=64, n_steps=9)
    return write_encoded(tmp_path_factory.mktemp("videos") / "scene", made), made


def test_encoded_videos_equal_their_frames(videos):
    folder, made = videos
    scene = Scene.open(folder)
    assert (scene.n_steps, scene.n_cams, scene.fps) == (9, 3, FPS)
    whole = scene.recorded_images(range(3), range(9))
    error = whole.permute(0, 1, 3, 4, 2).float() - torch.from_numpy(made.rgb)
    assert error.abs().mean() < 3
    for steps in ([4], [7, 2], [8, 8, 0]):
        assert torch.equal(Scene.open(folder).recorded_images([1], steps), whole[steps][:, [1]])


def test_encoded_videos_leave_no_file_open(videos):
    folder, _ = videos
    scene = Scene.open(folder)
    before = len(os.listdir("/proc/self/fd"))
    scene.recorded_images(range(3), [0, 5])
    reader = scene.recording.read_images(0, range(9), None)
    next(reader)
    reader.close()
    scene.segmentation(range(3), range(9))
    assert len(os.listdir("/proc/self/fd")) <= before


def test_broken_videos_are_named(videos, tmp_path):
    folder, made = videos
    broken = write_encoded(tmp_path / "scene", make_scene(width=96, height=64, n_steps=9))
    file = broken / "video_1.mp4"
    data = file.read_bytes()
    for content in (b"", b"no video at all", data[: len(data) // 2]):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"video_1.mp4 \(camera video_1\)"):
            Scene.open(broken).recorded_images([1], range(9))
    write_video(file, list(made.rgb[:7, 1]), FPS)
    with pytest.raises(InputError, match="camera video_1 has 7 frames, camera video_0 9; missing: frame 7, 8"):
        Scene.open(broken)
    content = json.loads((broken / "cameras.json").read_text())
    aligned = {**content, "cameras": [{**camera, "offset": 0.0} for camera in content["cameras"]]}
    (broken / "cameras.json").write_text(json.dumps(aligned))  # as gsim3d calibrate writes them
    scene = Scene.open(broken)
    assert scene.n_steps == 7 and "end at different times: 7 of 9 frames are common" in scene.recording.notes[-1]
    (broken / "cameras.json").write_text(json.dumps(content))
    write_video(file, [image[:32] for image in made.rgb[:, 1]], FPS)
    with pytest.raises(InputError, match=r"video_1.mp4 \(camera video_1\) has 96x32 pixels, its camera 96x64"):
        Scene.open(broken)
    assert any("video_1.mp4" in problem for problem in check_scene(broken).problems)
    file.unlink()
    with pytest.raises(InputError, match="camera video_1 needs a folder video_1 with frames"):
        Scene.open(broken)


def test_truncated_video_is_named(videos, tmp_path):
    """In AVI the frames come before their index, so that a file without its end can still be opened."""
    _, made = videos
    folder = write_encoded(tmp_path / "scene", made)
    (folder / "video_2.mp4").unlink()
    writer = cv2.VideoWriter(str(folder / "video_2.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (96, 64))
    for image in made.rgb[:, 2]:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    assert Scene.open(folder).recorded_images([2], [8]).float().mean() > 5
    data = (folder / "video_2.avi").read_bytes()
    (folder / "video_2.avi").write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(
        InputError, match=r"video_2.avi.*(ends before frame|cannot be opened|cannot be decoded)|video_2 has"
    ):
        Scene.open(folder).recorded_images([2], range(9))
    assert any("video_2" in problem for problem in check_scene(folder).problems)


def test_truncated_images_are_named(tmp_path):
    """OpenCV fills the rest of a JPEG with grey; a thumbnail's end inside the header is not the end of the image."""
    folder = write_videos(tmp_path, make_scene())
    for file in (folder / "cam_1").glob("*.png"):
        cv2.imwrite(str(file.with_suffix(".jpg")), cv2.imread(str(file)))
        file.unlink()
    assert Scene.open(folder).recorded_images([1], [0]).float().mean() > 5
    file = folder / "cam_1" / "004.jpg"
    data = file.read_bytes()
    thumbnail = b"\xff\xe1" + (2 + 400).to_bytes(2, "big") + b"\xff\xd8" + bytes(396) + b"\xff\xd9"
    whole = data[:2] + thumbnail + data[2:]
    file.write_bytes(whole)
    assert Scene.open(folder).recorded_images([1], [2]).float().mean() > 5
    for cut in (whole[: len(whole) * 3 // 4], whole[:-2]):
        file.write_bytes(cut)
        with pytest.raises(InputError, match=r"004.jpg \(camera cam_1, frame 4\) cannot be decoded: it is truncated"):
            Scene.open(folder).recorded_images([1], [2])


def test_videos_frame_numbers_are_times(tmp_path):
    scene = Scene.open(write_videos(tmp_path, make_scene(), stride=3))
    assert scene.fps == pytest.approx(FPS) and scene.n_steps == N_STEPS
    edit_json(tmp_path / "cameras.json", lambda content: content.pop("fps"))
    with pytest.raises(InputError, match="fps is needed"):
        Scene.open(tmp_path)


def test_videos_units_and_pixel_centres(tmp_path):
    plain = Scene.open(write_videos(tmp_path, make_scene()))

    def edit(content):
        content |= {"units": "mm", "pixel_center": 0, "origin": [-2000, -2500, -1000], "near": 1000, "far": 5000}
        content["bounds"] = (1000 * np.array(content["bounds"])).tolist()
        for camera in content["cameras"]:
            camera["T"] = [1000 * t for t in camera["T"]]
            camera["K"][0][2] -= 0.5
            camera["K"][1][2] -= 0.5
        return content

    edit_json(tmp_path / "cameras.json", edit)
    scene = Scene.open(tmp_path)
    for a, b in zip(vars(scene.cameras_at([0, 1], [0])).values(), vars(plain.cameras_at([0, 1], [0])).values()):
        assert torch.allclose(a, b, rtol=1e-5) if isinstance(a, torch.Tensor) else a == b
    assert scene.origin.tolist() == plain.origin.tolist() and scene.bounds.tolist() == plain.bounds.tolist()
    for key, value in (("units", "feet"), ("pixel_center", 0.25), ("masks", "all")):
        edit_json(tmp_path / "cameras.json", lambda content: content.update({key: value}))
        with pytest.raises(InputError, match=key):
            Scene.open(tmp_path)
        edit_json(tmp_path / "cameras.json", lambda content: content.pop(key))


MISTAKES = {
    "pixel_centre": ({"pixel_centre": 0}, {}, "pixel_centre is no key of this file; did you mean pixel_center?"),
    "unit": ({"unit": "mm"}, {}, "unit is no key of this file; did you mean units?"),
    "distorsion": ({}, {"distorsion": [0.1, 0, 0, 0]}, "distorsion is"),
    "time_offset": ({}, {"time_offset": 0.1}, "time_offset is .* did you mean offset?"),
    "video_fps": ({"video_fps": 25}, {}, "video_fps is .* did you mean fps?"),
    "near_plane": ({"near_plane": 0.1}, {}, "near_plane is .* did you mean near?"),
    "units of a camera": ({}, {"units": "mm"}, "camera .*: units belongs to the top level"),
    "near of a camera": ({}, {"near": 2.0}, "camera .*: near belongs to the top level"),
}


@pytest.mark.parametrize("kind", MISTAKES)
def test_videos_keys_are_not_ignored(tmp_path, kind):
    top, own, message = MISTAKES[kind]
    folder = write_videos(tmp_path, make_scene())
    edit_json(folder / "cameras.json", lambda content: (content.update(top), content["cameras"][1].update(own)))
    with pytest.raises(InputError, match="cameras.json: .*" + message):
        Scene.open(folder)


def test_videos_keys_of_all_cameras_may_be_at_the_top(tmp_path):
    folder = write_videos(tmp_path, make_scene())
    edit_json(folder / "cameras.json", lambda content: content.update(k1=0.1, author="me", frames=4))
    assert all(lens.coefficients[0] == 0.1 for lens in Scene.open(folder).recording.distortions)


def test_names_of_videos_may_end_in_capitals(tmp_path):
    folder = write_videos(tmp_path, make_scene())
    shutil.rmtree(folder / "cam_0")
    edit_json(folder / "cameras.json", lambda content: content.update(masks="none", cameras=content["cameras"][:1]))
    write_plain(folder / "cam_0.mp4", 4, 24, (48, 32)).rename(folder / "cam_0.MP4")
    assert Scene.open(folder).images([0], range(4)).shape == (4, 1, 3, 32, 48)


def test_image_cache_files_equal_videos(odd, tmp_path):
    folder, _ = odd
    mapped, plain = Scene.open(folder, cache_dir=tmp_path / "cache"), Scene.open(folder)
    for scene in (mapped, Scene.open(folder, cache_dir=tmp_path / "cache")):
        assert torch.equal(scene.images([0, 2], [3, 1]), plain.images([0, 2], [3, 1]))
        assert torch.equal(scene.segmentation([1], [5]), plain.segmentation([1], [5]))
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_transforms_without_time_are_one_step_of_many_cameras(tmp_path):
    write_transforms(tmp_path, make_scene(n_steps=1))

    def edit(content):
        content.pop("fps")
        for frame in content["frames"]:
            frame.pop("time")

    edit_json(tmp_path / "transforms.json", edit)
    scene = Scene.open(tmp_path)
    assert (scene.n_steps, scene.n_cams) == (1, N_CAMS) and scene.camera_names[1] == "images/cam_1/frame_00001.png"


def test_transforms_name_cameras_by_key_or_path(tmp_path):
    made = make_scene()
    write_transforms(tmp_path, made)

    def by_time(content):
        for frame in content["frames"]:
            _, camera, name = frame["file_path"].split("/")
            frame["camera"] = camera
            frame["file_path"] = f"images/{name[6:11]}/{camera}.png"
            save(tmp_path / frame["file_path"], made.rgb[int(name[6:11]) - 1, int(camera[4:])])

    edit_json(tmp_path / "transforms.json", by_time)
    scene = Scene.open(tmp_path)
    assert scene.camera_names == ("cam_0", "cam_1", "cam_2")
    np.testing.assert_array_equal(scene.images(range(3), range(4)).permute(0, 1, 3, 4, 2), made.rgb)
    edit_json(tmp_path / "transforms.json", lambda content: [frame.pop("camera") for frame in content["frames"]])
    with pytest.raises(InputError, match="give every frame its camera"):
        Scene.open(tmp_path)


def test_loss_and_metrics_leave_padding_out(odd, tmp_path, one_thread):
    """Other colours in pixels that were not recorded change neither the loss nor its gradient, elsewhere they do."""
    scene = Scene.open(odd[0])
    data, phase = DataConfig(history=1, context_views=2), PhaseConfig(steps=1, horizon=1, target_views=3)
    trainer = Trainer(TrainConfig(data=data, phases=(phase,)), [scene], tmp_path / "run")
    batch = draw_batch([scene], data, phase, 0, 0, [0])
    assert batch.targets.valid is not None and not batch.targets.valid.all()
    noise = torch.rand(batch.targets.images.shape, generator=torch.Generator().manual_seed(0))

    def result(where):
        images = torch.where(where[:, None], noise, batch.targets.images)
        targets = dataclasses.replace(batch.targets, images=images)
        loss, errors = trainer.loss(dataclasses.replace(batch, targets=targets))
        loss.backward()
        grads = [p.grad.clone() for p in trainer.simulator.parameters() if p.grad is not None]
        trainer.simulator.zero_grad()
        return loss, errors, grads

    nowhere = torch.zeros_like(batch.targets.valid)
    loss, errors, grads = result(nowhere)
    padded = result(~batch.targets.valid)
    assert torch.equal(padded[0], loss) and torch.equal(padded[1], errors)
    assert all(torch.equal(a, b) for a, b in zip(padded[2], grads, strict=True))
    assert not torch.equal(result(~nowhere)[0], loss)


def test_commands_run_on_videos(odd, tmp_path, capsys, one_thread):
    folder, _ = odd
    (tmp_path / "train.yaml").write_text(
        "data: {history: 2, context_views: 2}\nphases:\n  - {steps: 1, horizon: 1, target_views: 2}\n"
    )
    run = ["train", tmp_path / "train.yaml", "--data", folder, "--out", tmp_path / "run"]
    simulate = ["simulate", tmp_path / "run", folder, "--out", tmp_path / "out", "--steps", "2"]
    evaluate = ["evaluate", tmp_path / "run", folder, "--steps", "2", "--out", tmp_path / "metrics.json"]
    check = ["check-data", folder, "--out", tmp_path / "sheet.png"]
    for command in (run, simulate, evaluate, check):
        assert main([str(word) for word in command]) == 0, capsys.readouterr().err
    assert (tmp_path / "out" / "rollout.mp4").is_file()
    assert np.isfinite(json.loads((tmp_path / "metrics.json").read_text())["future.psnr"])
    assert "3 cameras" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[1] > 400
