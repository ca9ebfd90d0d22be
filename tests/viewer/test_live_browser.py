"""The live viewer in a headless Chromium."""

import dataclasses
import time

import cv2
import numpy as np
import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.io import read_splats
from gsim3d.math.rotations import rotation_matrices
from gsim3d.numerics.trust import Trust
from gsim3d.ops import rasterize_gaussians
from gsim3d.train.restore import restore
from gsim3d.viewer import server
from gsim3d.viewer.simulation import Simulation
from tests.viewer.browser import Browser, chromium
from tests.viewer.test_live import RED, splats, target_of
from tests.viewer.test_player import make

pytestmark = [
    pytest.mark.usefixtures("one_thread", "viser"),
    pytest.mark.skipif(chromium() is None, reason="no Chromium is installed"),
]
WIDTH, HEIGHT = 1000, 600
FREE = slice(320, 660)  # columns that neither panel nor notices cover
LABEL = "[...document.querySelectorAll('label')].find(one => one.textContent === '{}')"
FIELD = f"{LABEL}.parentElement.parentElement.parentElement.querySelector('input, textarea')"
LEAF = "[...document.querySelectorAll('{}')].find(one => one.textContent === '{}')"
TYPED = """(field => {{
  Object.getOwnPropertyDescriptor(Object.getPrototypeOf(field), 'value').set.call(field, '{}');
  field.dispatchEvent(new Event('input', {{bubbles: true}}));
}})({})"""
BUTTON = "[...document.querySelectorAll('button')].find(button => button.textContent === '{}')"
# viser 1.1.1 draws splats as a quad whose corners have two coordinates; three.js misses the third where it culls.
BENIGN = "computeBoundingSphere(): Computed radius is NaN"


def shot(browser) -> np.ndarray:
    """RGB image of the page in [0, 1]."""
    image = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return image[..., ::-1] / 255


def until(condition, seconds=60):
    """Waits for what ``condition`` returns to be true, and returns it."""
    end = time.monotonic() + seconds
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.1)
    assert found
    return found


def camera_of(viewer) -> Cameras:
    """The camera of the only browser."""
    (client,) = viewer.server.get_clients().values()
    seen = client.camera
    rotation = rotation_matrices(torch.from_numpy(np.array(seen.wxyz))[None])[0].T
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ torch.from_numpy(np.array(seen.position))
    focal = 0.5 * seen.image_height / np.tan(0.5 * seen.fov)
    K = torch.tensor([[focal, 0, seen.image_width / 2], [0, focal, seen.image_height / 2], [0, 0, 1]])
    one, size = torch.ones(1), (seen.image_width, seen.image_height)
    return Cameras(viewmat[None].float(), K[None].float(), 0.01 * one, 100 * one, torch.tensor([0]), *size)


def pixel_of(camera, point) -> tuple[int, int]:
    x, y, z = camera.Ks[0] @ (camera.viewmats[0, :3, :3] @ point + camera.viewmats[0, :3, 3])
    return int(x / z), int(y / z)


def rendered(gaussians, camera) -> np.ndarray:
    """Of the package, on white."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    image = rasterize_gaussians(*fields, camera, sh=gaussians.sh)
    return (image.color[0] + 1 - image.alpha[0].reshape(*image.color[0].shape[:2], 1)).clamp(0, 1).numpy()


def test_browser_shows_what_the_package_renders_plays_pauses_and_scrubs():
    first = make(40, degree=0)
    red = splats([[0.0, 0.0, 1.7]], RED)
    names = ("means", "quats", "scales", "opacities", "sh")
    both = {name: torch.cat([getattr(first, name), getattr(red, name)]) for name in names}
    both = dataclasses.replace(first, **both, cu_rows=torch.tensor([0, 41]))
    frames = [dataclasses.replace(both, means=both.means - torch.tensor([0, 0, 0.2 * step])) for step in range(3)]
    with server.Viewer(target_of(frames)) as viewer, Browser(WIDTH, HEIGHT) as browser:
        browser.open(viewer.address)
        until(lambda: 0.02 < (shot(browser)[:, FREE].min(-1) < 0.9).mean() < 0.9)
        camera = camera_of(viewer)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)

        def found(frame) -> float:  # PSNR of what is not white in both
            own = rendered(frames[frame], camera)[:, FREE]
            seen = np.minimum(own, image[:, FREE]).min(-1) < 0.98
            return -10 * np.log10(np.square(own - image[:, FREE])[seen].mean())

        def shows(frame) -> bool:
            nonlocal image
            image = shot(browser)
            return found(frame) > 30

        def press(label) -> None:
            browser.wait(f"Boolean({BUTTON.format(label)})", 20)
            browser.value(f"{BUTTON.format(label)}.click()")

        image = shot(browser)
        until(lambda: shows(0), 20)
        column, row = pixel_of(camera, red.means[0])
        assert np.abs(image[row, column] - RED).max() < 0.05
        assert found(1) < 30 and found(2) < 30

        browser.value("document.querySelector('[role=slider]').focus()")
        for frame in (1, 2):
            browser.press("ArrowRight")
            until(lambda frame=frame: viewer.timeline.frame == frame, 20)
            until(lambda frame=frame: shows(frame), 20)

        seen = set()
        press("Play")
        until(lambda: seen.add(viewer.timeline.frame) or len(seen) == 3, 20)
        press("Pause")
        until(lambda: not viewer.timeline.playing, 20)
        frame = viewer.timeline.frame
        until(lambda: np.array_equal(shot(browser)[:, FREE], shot(browser)[:, FREE]) and shows(frame), 20)
        assert viewer.timeline.frame == frame

        assert not [text for text in browser.complaints if BENIGN not in text]
        local = ("data:", "blob:", viewer.address, viewer.address.replace("http:", "ws:"))
        assert not [url for url in browser.requests if not url.startswith(local)]


def test_a_click_in_the_browser_chooses_the_body_under_it(simulation):
    with server.Viewer(simulation.target, simulation) as viewer, Browser(WIDTH, HEIGHT) as browser:
        browser.open(viewer.address)
        until(lambda: len(viewer.server.get_clients()) == 1)
        until(lambda: (shot(browser)[:, FREE].min(-1) < 0.9).mean() > 0.01)
        viewer.timeline.seek(3)
        viewer.draw()
        rows = simulation.bodies(3)[0]
        point = simulation.target.particles[3].means[rows].median(0).values
        place = pixel_of(camera_of(viewer), point)
        browser.drag(place, place)
        until(lambda: viewer._panel._inside.value, 20)
        middle, half = np.array(viewer._panel._middle.value), np.array(viewer._panel._sides.value) / 2
        assert viewer._panel._which.value.startswith("body ") and (np.abs(point.numpy() - middle) < half).all()
        assert not [text for text in browser.complaints if BENIGN not in text]


def test_trust_is_seen_and_usd_written_from_the_browser(checkpoint, scene, tmp_path):
    pytest.importorskip("pxr", reason="needs usd-core")
    restored = restore(checkpoint)
    restored.simulator.trust = Trust(2, 3, 0.5, 1.0, (-9.0, 0.0), (0.9,), ((0.01, 0.1),), {}, 3.0)
    simulation = Simulation(restored, restored.open_scene(scene), 3)
    target = simulation.target
    with server.Viewer(target, simulation) as viewer, Browser(WIDTH, HEIGHT) as browser:
        browser.open(viewer.address)
        until(lambda: (shot(browser)[:, FREE].min(-1) < 0.9).mean() > 0.01)
        viewer.timeline.seek(4)
        viewer.draw()
        browser.value(f"{FIELD.format('Colours')}.click()")
        browser.wait(f"Boolean({LEAF.format('[role=option]', 'trust')})", 20)
        browser.value(f"{LEAF.format('[role=option]', 'trust')}.click()")
        until(lambda: viewer.layers.coloring == "trust", 60)
        worst = target.colors(4, "trust").unique(dim=0)
        assert len(worst) > 2
        until(lambda: (np.abs(shot(browser)[:, FREE, 0] - shot(browser)[:, FREE, 2]) > 0.3).mean() > 0.005, 20)
        browser.value(f"{LEAF.format('p,span,div', 'Export')}.click()")
        for name in ("seen.usda", "seen.usdc"):
            file = tmp_path / name
            browser.wait(f"Boolean({BUTTON.format('Write what is seen')})", 20)
            browser.value(TYPED.format(file, FIELD.format("File")))
            time.sleep(0.5)
            browser.value(f"{BUTTON.format('Write what is seen')}.click()")
            until(file.is_file, 30)
            seen, read = target.seen(4, viewer.layers), read_splats(file)
            order = [one.means[:, 0].argsort() for one in (seen, read)]
            torch.testing.assert_close(read.means[order[1]], seen.means[order[0]])
            torch.testing.assert_close(read.sh[order[1], 0], seen.sh[order[0], 0])
        assert not [text for text in browser.complaints if BENIGN not in text]
