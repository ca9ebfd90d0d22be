"""Cameras and images: conventions, labels against projected geometry, light and shadow."""

import numpy as np
import pytest

from gsim3d.synth import cameras, render, shapes

SIZE = 48


@pytest.fixture(scope="module")
def rig():
    return cameras.two_rings(
        4, SIZE, 1.5, 3.8, distance=2.6, target_height=0.5, elevations=(18.0, 42.0), fov=42.0
    )  # fmt: skip


def draw(rig, vertices, faces, *, samples=2, background=(0, 0, 0)):
    white = lambda corners: np.ones((len(corners), 3))  # noqa: E731
    surface = render.Surface(faces, vertices[faces], white)
    ground = render.Ground(0.85, 0.0)
    renderer = render.Renderer(rig, [surface], ground=ground, background=background, samples=samples)
    return renderer.draw([vertices])


@pytest.fixture(scope="module")
def ball():
    vertices, faces = shapes.icosphere(3)
    return 0.3 * vertices + [0.1, -0.1, 0.6], faces


def test_two_rings_look_at_the_target(rig):
    target = np.array([[0.0, 0.0, 0.5]])
    pixels, depth = cameras.project(target, rig.viewmats, rig.Ks)
    np.testing.assert_allclose(pixels[:, 0], SIZE / 2, atol=1e-9)
    np.testing.assert_allclose(depth, 2.6, atol=1e-12)
    for viewmat in rig.viewmats:
        np.testing.assert_allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(viewmat[:3, :3]) > 0
    up, _ = cameras.project(target + [0, 0, 0.1], rig.viewmats, rig.Ks)
    assert (up[:, 0, 1] < SIZE / 2).all()  # world up is up in the image: y counts down


def test_pixel_rays_invert_projection(rig):
    origins, directions = cameras.pixel_rays(rig, 2)
    assert directions.shape == (4, SIZE, SIZE, 4, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-12)
    for cam in range(rig.n_cams):
        points = origins[cam] + 2.0 * directions[cam].reshape(-1, 3)
        pixels, _ = cameras.project(points, rig.viewmats, rig.Ks)
        pixels = pixels[cam].reshape(SIZE, SIZE, 4, 2)
        y, x = np.indices((SIZE, SIZE))
        expected = np.stack([x, y], -1)[:, :, None] + [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
        np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_workspace_origin_lies_below_every_pixel_in_range(rig):
    origin = cameras.workspace_origin(rig)
    origins, directions = cameras.pixel_rays(rig, 1)
    forward = rig.viewmats[:, 2, :3]
    cosine = np.einsum("vhwsc,vc->vhws", directions, forward)[..., None]
    for depth in (rig.near, rig.far):
        points = origins[:, None, None, None] + directions / cosine * depth
        assert (points >= origin).all()


def test_renderer_labels_match_the_projected_mesh(rig, ball):
    vertices, faces = ball
    view = draw(rig, vertices, faces)
    pixels, _ = cameras.project(vertices, rig.viewmats, rig.Ks)
    for cam in range(rig.n_cams):
        y, x = np.nonzero(view.segmentation[cam] == render.BODY)
        np.testing.assert_allclose([x.min(), y.min()], pixels[cam].min(0), atol=1.0)
        np.testing.assert_allclose([x.max() + 1, y.max() + 1], pixels[cam].max(0), atol=1.0)


def test_renderer_labels_match_the_ground_disc(rig, ball):
    view = draw(rig, ball[0] + [0, 0, 50], ball[1])
    y, x = np.indices((SIZE, SIZE)) + 0.5
    for cam in range(rig.n_cams):
        rotation, K = rig.viewmats[cam, :3, :3], rig.Ks[cam]
        position = -rotation.T @ rig.viewmats[cam, :3, 3]
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1) @ rotation
        hit = position + rays * (-position[2] / rays[..., 2:])
        reach = np.where(rays[..., 2] < 0, np.hypot(hit[..., 0], hit[..., 1]), np.inf)
        labels = view.segmentation[cam]
        assert (labels[reach < 0.8] == render.GROUND).all() and (labels[reach > 0.95] == render.BACKGROUND).all()
    assert set(np.unique(view.segmentation)) == {render.BACKGROUND, render.GROUND}


def test_renderer_instances_agree_with_labels(rig, ball):
    view = draw(rig, *ball)
    assert set(np.unique(view.segmentation)) == {0, 1, 3} and set(np.unique(view.instances)) == {0, 1, 2}
    assert ((view.instances == 2) == (view.segmentation == 3)).all()
    assert ((view.instances == 1) == (view.segmentation == 1)).all()


@pytest.mark.parametrize("value", [0, 255])
def test_renderer_background_colour(rig, ball, value):
    view = draw(rig, *ball, background=[value / 255] * 3)
    assert (view.rgb[view.segmentation == render.BACKGROUND].mean(0) * (1 if value else -1) > -20 + value * 0.9).all()
    assert (view.rgb[:, 0, 0] == value).all()


def test_renderer_occlusion_of_body_and_ground(rig, ball):
    vertices, faces = ball
    below = draw(rig, vertices * 0.5 - [0, 0, 0.5], faces)
    assert not (below.segmentation == render.BODY).any()
    above = draw(rig, vertices, faces)
    assert (above.segmentation == render.BODY).any((1, 2)).all()


def test_renderer_shadow_position(rig, ball):
    vertices, faces = ball
    lit = draw(rig, vertices + [0, 0, 50], faces)
    dark = draw(rig, vertices, faces)
    centre = vertices.mean(0)
    spot = centre - render.LIGHT_DIRECTION * (centre[2] / render.LIGHT_DIRECTION[2])
    pixels, _ = cameras.project(spot[None], rig.viewmats, rig.Ks)
    checked = 0
    for cam, (x, y) in enumerate(np.floor(pixels[:, 0]).astype(int)):
        ground = dark.segmentation[cam] == render.GROUND
        if ground[y, x]:
            ratio = dark.rgb[cam, y, x].astype(float) / lit.rgb[cam, y, x]
            expected = render.AMBIENT / (render.AMBIENT + render.DIFFUSE * render.LIGHT_DIRECTION[2])
            np.testing.assert_allclose(ratio, expected, atol=0.02)
            checked += 1
        darker = ground & (dark.rgb[cam].sum(-1) < lit.rgb[cam].sum(-1))
        assert 0 < darker.sum() < 0.3 * ground.sum()
    assert checked >= 2


def test_renderer_shades_a_sphere(rig):
    vertices, faces = shapes.icosphere(5)
    vertices = 0.3 * vertices + [0, 0, 1.0]
    view = draw(rig, vertices, faces, samples=1)
    origins, directions = cameras.pixel_rays(rig, 1)
    errors = []
    for cam in range(rig.n_cams):
        y, x = np.nonzero(view.segmentation[cam] == render.BODY)
        ray = directions[cam, y, x, 0]
        to_centre = np.array([0, 0, 1.0]) - origins[cam]
        along = ray @ to_centre
        inside = 0.09 - (to_centre @ to_centre - along**2)
        keep = inside > 0.01
        point = origins[cam] + ray * (along - np.sqrt(np.maximum(inside, 0)))[:, None]
        normal = (point - [0, 0, 1.0]) / 0.3
        light = render.AMBIENT * (0.75 + 0.25 * normal[:, 2])
        light += render.DIFFUSE * np.maximum(normal @ render.LIGHT_DIRECTION, 0)
        errors.append(np.abs(np.minimum(255 * light, 255) - view.rgb[cam, y, x, 0])[keep])
    assert np.concatenate(errors).max() < 4


def test_renderer_samples_smooth_outlines(rig, ball):
    rough, smooth = draw(rig, *ball, samples=1), draw(rig, *ball, samples=4)
    assert (rough.segmentation != smooth.segmentation).mean() < 0.02
    np.testing.assert_allclose(rough.rgb.mean(), smooth.rgb.mean(), rtol=0.02)


def test_renderer_skips_bodies_beside_or_behind_cameras(rig, ball):
    far_up = draw(rig, ball[0] + [0, 0, 30], ball[1])
    assert not (far_up.segmentation == render.BODY).any()
    position = -rig.viewmats[0, :3, :3].T @ rig.viewmats[0, :3, 3]
    behind = draw(rig, ball[0] - ball[0].mean(0) + 1.5 * position, ball[1])
    assert not (behind.segmentation[0] == render.BODY).any()
