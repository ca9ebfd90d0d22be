"""One scene in every layout gives one and the same Scene; its points project to the pixels where they were drawn."""

import numpy as np
import pytest
import torch

from gsim3d.data import Scene, find_scenes, make_frames
from gsim3d.errors import InputError
from tests.data.made_scenes import (
    BOUNDS,
    COLOR,
    FAR,
    FPS,
    HEIGHT,
    N_CAMS,
    N_STEPS,
    NEAR,
    ORIGIN,
    WIDTH,
    WRITERS,
    edit_json,
    make_scene,
    write_genesis,
    write_kubric,
    write_transforms,
    write_videos,
)

CAMS, STEPS = range(N_CAMS), range(N_STEPS)


@pytest.fixture(params=[False, True], ids=["still", "moving"])
def made(request):
    return make_scene(moving=request.param)


@pytest.mark.parametrize("layout", WRITERS)
def test_layouts_give_the_same_scene(tmp_path, made, layout):
    scene = Scene.open(WRITERS[layout](tmp_path / "scene", made))
    assert scene.layout == layout.split("'")[0]
    assert (scene.n_steps, scene.n_cams, scene.width, scene.height) == (N_STEPS, N_CAMS, WIDTH, HEIGHT)
    assert scene.fps == pytest.approx(FPS) and (scene.near, scene.far) == (NEAR, FAR)
    assert scene.origin.tolist() == ORIGIN and scene.bounds.tolist() == BOUNDS
    np.testing.assert_array_equal(scene.images(CAMS, STEPS).permute(0, 1, 3, 4, 2), made.rgb)
    np.testing.assert_array_equal(scene.segmentation(CAMS, STEPS), made.labels)
    assert scene.valid(CAMS, STEPS) is None
    cameras = scene.cameras_at(CAMS, STEPS)
    assert cameras.image_cloud.tolist() == np.repeat(STEPS, N_CAMS).tolist()
    np.testing.assert_allclose(cameras.viewmats.unflatten(0, (N_STEPS, N_CAMS)), made.viewmats, atol=2e-6)
    np.testing.assert_allclose(cameras.Ks.unflatten(0, (N_STEPS, N_CAMS)), made.Ks, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("layout", WRITERS)
def test_layouts_project_the_ball_to_its_pixels(tmp_path, made, layout):
    scene = Scene.open(WRITERS[layout](tmp_path, made))
    images = scene.images(CAMS, STEPS).flatten(0, 1)
    cameras = scene.cameras_at(CAMS, STEPS)
    for row, (viewmat, K) in enumerate(zip(cameras.viewmats.double(), cameras.Ks.double())):
        local = viewmat[:3, :3] @ torch.from_numpy(made.centers[row // N_CAMS]) + viewmat[:3, 3]
        assert NEAR < local[2] < FAR
        image = K @ local / local[2]
        y, x = torch.nonzero((images[row] == torch.from_numpy(COLOR)[:, None, None]).all(0)).double().T
        # The outline of a ball of 0.22 m at 3 m is nearly a circle around its centre.
        assert abs(x.mean() + 0.5 - image[0]) < 0.35 and abs(y.mean() + 0.5 - image[1]) < 0.35


@pytest.mark.parametrize("layout", WRITERS)
def test_make_frames_has_cameras_of_each_step(tmp_path, layout):
    made = make_scene(moving=True)
    frames = make_frames([Scene.open(WRITERS[layout](tmp_path, made))], [[2, 0]], [[1, 3]])
    for row, (step, cam) in enumerate([(1, 2), (1, 0), (3, 2), (3, 0)]):
        np.testing.assert_allclose(frames.cameras.viewmats[row], made.viewmats[step, cam], atol=2e-6)
        np.testing.assert_array_equal(frames.masks[row], made.labels[step, cam] > 0)
        np.testing.assert_array_equal(frames.dynamic[row], made.labels[step, cam] == 3)


@pytest.mark.parametrize("layout", ["genesis", "transforms", "videos"])
@pytest.mark.parametrize("moving", [False, True])
def test_layouts_read_changing_intrinsics(tmp_path, layout, moving):
    made = make_scene(moving=moving, zoom=0.1)
    scene = Scene.open(WRITERS[layout](tmp_path, made))
    cameras = scene.cameras_at(CAMS, STEPS)
    np.testing.assert_allclose(cameras.Ks.unflatten(0, (N_STEPS, N_CAMS)), made.Ks, rtol=1e-6)
    np.testing.assert_allclose(cameras.viewmats.unflatten(0, (N_STEPS, N_CAMS)), made.viewmats, atol=2e-6)
    assert not torch.equal(cameras.Ks[0], cameras.Ks[-N_CAMS])


def test_layouts_undistort_the_same_lens_alike(tmp_path):
    lens = {"k1": 0.2, "k2": 0.05, "p1": 0.002, "p2": -0.004, "k3": 0.01}
    made = make_scene(zoom=0.05)
    videos, transforms = write_videos(tmp_path / "videos", made), write_transforms(tmp_path / "transforms", made)
    plain = Scene.open(videos).recorded_images(CAMS, STEPS)
    edit_json(
        videos / "cameras.json", lambda content: [c.update(distortion=[*lens.values()]) for c in content["cameras"]]
    )
    edit_json(transforms / "transforms.json", lambda content: content.update(lens))
    one, other = Scene.open(videos), Scene.open(transforms)
    assert torch.equal(one.images(CAMS, STEPS), other.images(CAMS, STEPS))
    assert torch.equal(one.segmentation(CAMS, STEPS), other.segmentation(CAMS, STEPS))
    assert torch.equal(one.valid(CAMS, STEPS), other.valid(CAMS, STEPS)) and not one.valid(CAMS, STEPS).all()
    assert not torch.equal(one.recorded_images(CAMS, STEPS), plain)
    assert not (one.segmentation(CAMS, STEPS)[~one.valid(CAMS, STEPS)]).any()


def test_cameras_at_steps_beyond_the_end_equal_the_last(tmp_path):
    scene = Scene.open(write_videos(tmp_path, make_scene(moving=True)))
    cameras = scene.cameras_at([1], [2, 3, 4, 9])
    assert torch.equal(cameras.viewmats[1], cameras.viewmats[3]) and cameras.image_cloud.tolist() == [0, 1, 2, 3]
    assert not torch.equal(cameras.viewmats[0], cameras.viewmats[1])


def test_find_scenes_of_mixed_layouts(tmp_path):
    made = make_scene()
    for name, write in (("a/2", write_genesis), ("a/10", write_videos), ("b", write_kubric), (".c", write_videos)):
        write(tmp_path / name, made)
    write_transforms(tmp_path / "d" / "e" / "f", made)
    found = [path.relative_to(tmp_path).as_posix() for path in find_scenes(tmp_path)]
    assert found == ["a/2", "a/10", "b", "d/e/f"]
    assert [Scene.open(tmp_path / name).layout for name in found] == ["genesis", "videos", "kubric", "transforms"]
    assert find_scenes(tmp_path / "b") == [tmp_path / "b"]


def test_kubric_single_camera_is_a_scene(tmp_path):
    made = make_scene()
    write_kubric(tmp_path, made)
    scene = Scene.open(tmp_path / "cam_1")
    assert (scene.layout, scene.n_cams) == ("kubric", 1)
    np.testing.assert_array_equal(scene.images([0], STEPS)[:, 0].permute(0, 2, 3, 1), made.rgb[:, 1])


def test_kubric_frame_number_is_the_number_of_its_pose(tmp_path):
    made = make_scene(moving=True)
    write_kubric(tmp_path, made)
    for file in [*tmp_path.rglob("*_0.png"), *tmp_path.rglob("*_2.png")]:
        file.unlink()
    scene = Scene.open(tmp_path)
    assert scene.n_steps == 2 and scene.fps == pytest.approx(FPS / 2)
    cameras = scene.cameras_at(CAMS, [0, 1])
    np.testing.assert_allclose(cameras.viewmats.unflatten(0, (2, N_CAMS)), made.viewmats[[1, 3]], atol=2e-6)
    np.testing.assert_array_equal(scene.segmentation(CAMS, [0, 1]), made.labels[[1, 3]])


def test_layout_of_other_folders_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no meta.yaml, metadata.json, transforms.json, cameras.json or sparse/0"):
        Scene.open(tmp_path)
