"""The HTML player: what is packed comes back within its bounds, and a browser shows it as the package renders it."""

import base64
import dataclasses
import json
import re
import zlib
from importlib.resources import files

import cv2
import numpy as np
import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.errors import InputError
from gsim3d.evaluate.metrics import psnr
from gsim3d.io.orbit import picture
from gsim3d.math.rotations import rotate_left
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.ops import rasterize_gaussians
from gsim3d.state import Gaussians
from gsim3d.viewer import write_player
from gsim3d.viewer.player import POSITION_STEP, POSTER, View
from tests.viewer.browser import Browser, chromium

browsing = pytest.mark.skipif(chromium() is None, reason="no Chromium is installed")
SIZE, FPS = 360, 12.0


def make(count=120, degree=2, seed=0):
    g = torch.Generator().manual_seed(seed)
    n_sh = (degree + 1) ** 2
    sh = (torch.rand(count, n_sh, 3, generator=g) - 0.5) * torch.tensor([2.5] + [0.6] * (n_sh - 1))[:, None]
    return Gaussians(
        means=torch.rand(count, 3, generator=g) * torch.tensor([2.0, 2.0, 1.0]) - torch.tensor([1.0, 1.0, 0.0]),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1),
        scales=0.05 + 0.1 * torch.rand(count, 3, generator=g),
        opacities=0.3 + 0.69 * torch.rand(count, generator=g),
        sh=sh,
        cu_rows=torch.tensor([0, count]),
    )


def moving(n_frames, count=120, degree=2):
    """Gaussians that fall, turn and change their colours, a third of them."""
    first, g = make(count, degree), torch.Generator().manual_seed(1)
    third = count // 3
    speed, gain = torch.randn(third, 3, generator=g) * 0.05, torch.rand(third, 1, 3, generator=g)
    frames = []
    for step in range(n_frames):
        means, quats, sh = first.means.clone(), first.quats.clone(), first.sh.clone()
        means[:third] += step * speed + torch.tensor([0, 0, -0.01]) * step**2
        quats[:third] += 0.05 * step * torch.tensor([0.0, 1, 0, 0])
        sh[:third, :1] += 0.05 * step * gain
        frames.append(dataclasses.replace(first, means=means, quats=quats, sh=sh))
    return frames


def view():
    """From the side, a little above."""
    azimuth, elevation, distance = 0.7, 0.4, 5.0
    toward = torch.tensor([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -toward
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]).double()), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ (torch.tensor([0.0, 0, 0.5]).double() + distance * toward)
    K = np.array([[1.6 * SIZE, 0, SIZE / 2], [0, 1.6 * SIZE, SIZE / 2], [0, 0, 1]])
    return View(viewmat.numpy(), K, SIZE, SIZE)


def rendered(gaussians, seen, background=0.0):
    one = torch.ones(1)
    camera = Cameras(
        torch.from_numpy(seen.viewmat)[None].float(), torch.from_numpy(seen.K)[None].float(), one * 0.1, one * 20,
        torch.tensor([0]), seen.width, seen.height,
    )  # fmt: skip
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    background = torch.full((3,), background)
    return rasterize_gaussians(*fields, camera, sh=gaussians.sh, background=background).color[0].clamp(0, 1)


def unpacked(page):
    """Channel -> float64 [frames, count, width], decoded as the player does it."""
    header = json.loads(re.search(r'id="header">(.*?)</script>', page, re.DOTALL)[1])
    out = {}
    for name, channel in header["channels"].items():
        blob = re.search(rf'id="blob{channel["blob"]}">(.*?)</script>', page)[1]
        content = zlib.decompress(base64.b64decode(blob), -15)
        planes = np.frombuffer(content, np.uint8, offset=1).reshape(content[0], -1).astype(np.int64)
        zigzag = sum(plane << (8 * k) for k, plane in enumerate(planes))
        values = np.where(zigzag % 2, -(zigzag + 1) // 2, zigzag // 2)
        values = values.reshape(-1, channel["width"], header["count"]).transpose(0, 2, 1)
        for _ in range(channel["order"]):
            values = np.cumsum(values, 0)
        out[name] = np.broadcast_to(values * channel["step"], (header["frames"], *values.shape[1:]))
    return header, out


def test_player_quantisation_is_within_bounds(tmp_path):
    frames = moving(9)
    write_player(tmp_path / "a.html", frames, fps=FPS, title="A <ball>")
    page = (tmp_path / "a.html").read_text()
    header, channels = unpacked(page)
    assert header["fps"] == FPS and "A &lt;ball&gt;" in page and header["channels"]["scales"]["order"] == 0
    for step, frame in enumerate(frames):
        means = channels["means"][step] + header["middle"]
        assert np.abs(means - frame.means.numpy()).max() <= 0.5 * POSITION_STEP + 1e-6
        assert np.abs(np.exp(channels["scales"][step]) / frame.scales.numpy() - 1).max() <= 0.017
        quats = channels["quats"][step] / np.linalg.norm(channels["quats"][step], axis=1, keepdims=True)
        cosine = np.abs((quats * torch.nn.functional.normalize(frame.quats, dim=1).numpy()).sum(1)).clip(max=1)
        assert (2 * np.arccos(cosine)).max() < 2e-3
        assert np.abs(channels["opacities"][step][:, 0] - frame.opacities.numpy()).max() <= 0.5 / 255 + 1e-6
        colors = 0.5 + header["sh0"] * frame.sh[:, 0].numpy()
        assert np.abs(channels["colors"][step] - colors).max() <= 0.5 / 255 + 1e-6
        rest = channels["sh"][step].reshape(frame.sh.shape[0], -1, 3)
        assert np.abs(rest - frame.sh[:, 1:].numpy()).max() <= 0.5 / 128 + 1e-6


def test_player_poster_is_the_first_look(tmp_path):
    seen, frames = view(), moving(2)
    write_player(tmp_path / "a.html", frames, fps=FPS, view=seen, background=(0.2, 0.2, 0.2))
    content = re.search(r'id="poster".*?base64,([^"]+)', (tmp_path / "a.html").read_text())[1]
    image = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    K = seen.K * np.array([[POSTER / SIZE], [POSTER / SIZE], [1]])
    expected = rendered(frames[0], dataclasses.replace(seen, K=K, width=POSTER, height=POSTER), 0.2)
    assert float(psnr(torch.from_numpy(image.copy())[None].float() / 255, expected[None])) > 30


def test_player_is_small():
    sizes = [files("gsim3d.viewer").joinpath(name).stat().st_size for name in ("player.html", "player.js")]
    assert sum(sizes) <= 60_000


def test_player_frames_of_different_counts(tmp_path):
    long = make(40)
    fewer = {name: getattr(long, name)[:25] for name in ("means", "quats", "scales", "opacities", "sh")}
    short = dataclasses.replace(long, **fewer, cu_rows=torch.tensor([0, 25]))
    write_player(tmp_path / "a.html", [long, short], fps=FPS)
    _, channels = unpacked((tmp_path / "a.html").read_text())
    assert (channels["opacities"][1, 25:] == 0).all() and (channels["opacities"][1, :25] > 0).all()


def test_player_file_size_of_16k_gaussians(tmp_path):
    """80 frames of bodies that fall, turn and bounce."""
    g = torch.Generator().manual_seed(0)
    first = make(16_384, 0)
    spin, frames = 0.02 * torch.randn(16, 3, generator=g).repeat_interleave(1024, 0), []
    for step in range(80):
        height = abs(((step / 20 + 1) % 2) - 1) ** 2
        shift = torch.linalg.cross(spin * step, first.means) + torch.tensor([0.003 * step, 0, height])
        quats = rotate_left(first.quats, spin * step)
        frames.append(dataclasses.replace(first, means=first.means + shift, quats=quats))
    write_player(tmp_path / "a.html", frames, fps=42)
    assert (tmp_path / "a.html").stat().st_size <= 8e6


@pytest.mark.parametrize(
    "given, says",
    [
        ({"path": "a.mp4"}, "must end in .html"),
        ({"fps": 0.0}, "positive"),
        ({"frames": []}, "no frame"),
        ({"truth": [np.zeros((4, 4, 3), np.uint8)] * 2}, "2 true images for 1"),
        ({"truth": [np.zeros((4, 4))]}, "uint8"),
        ({"frames": [dataclasses.replace(make(3), means=torch.full((3, 3), torch.nan))]}, "not finite"),
        ({"view": View(np.eye(3), np.eye(3), 4, 4)}, "viewmat"),
    ],
)
def test_write_player_refuses_unusable_input(given, says, tmp_path):
    arguments = {"frames": [make(3)], "fps": FPS, "path": "a.html", **given}
    with pytest.raises(InputError, match=says):
        write_player(tmp_path / arguments.pop("path"), arguments.pop("frames"), **arguments)
    assert not list(tmp_path.iterdir())


@browsing
def test_player_of_a_file_does_not_call_it_predicted(tmp_path):
    write_player(tmp_path / "a.html", moving(2), fps=FPS)
    with Browser(SIZE, SIZE + 110) as browser:
        browser.open((tmp_path / "a.html").as_uri())
        browser.wait("globalThis.player && player.painted !== null")
        label = "document.getElementById('label')"
        assert browser.value(f"{label}.textContent === '' && getComputedStyle({label}).display === 'none'")


@browsing
def test_player_in_browser_equals_rasterizer(tmp_path):
    frames, seen = moving(10, degree=3), view()
    truth = [(rendered(frame, seen) * 255).byte().numpy() for frame in frames]
    write_player(tmp_path / "a.html", frames, fps=FPS, view=seen, truth=truth, start=3, title="Falling")
    url = (tmp_path / "a.html").as_uri()
    header = re.search(r'id="header">(.*?)</script>', (tmp_path / "a.html").read_text(), re.DOTALL)[1]
    with Browser(2 * SIZE + 2, SIZE + 110) as browser:
        browser.open(url)
        browser.wait("globalThis.player && player.painted !== null")
        assert browser.value("player.playing")
        browser.press(" ")
        assert not browser.value("player.playing")
        for key, frame in (("Home", 0), ("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", 9)):
            browser.press(key)
            assert browser.value("player.frame") == frame
        assert browser.value("document.getElementById('label').textContent") == "predicted"
        browser.value("scrub.value = 4, scrub.dispatchEvent(new Event('input'))")
        assert browser.value("player.frame") == 4 and browser.value("document.getElementById('time').textContent") == (
            "0.33 s / 0.75 s"
        )
        browser.wait("player.idle")
        for frame in (0, 6):
            before, painted = browser.value(f"(player.show({frame}), [truth.src, player.painted[0]])")
            assert painted != frame and before.endswith(json.loads(header)["truth"][painted])  # they change together
            browser.wait(f"player.idle && player.painted[0] === {frame}")
            browser.wait(f"truth.naturalWidth === {SIZE} && truth.clientWidth > {SIZE // 2}")
            assert browser.value("truth.src").endswith(json.loads(header)["truth"][frame])
            image = canvas_of(browser)
            side = min(image.shape[:2])
            top, left = ((length - side) // 2 for length in image.shape[:2])
            shown = torch.from_numpy(image[top : top + side, left : left + side].copy())
            K = seen.K * np.array([[side / SIZE], [side / SIZE], [1]])
            expected = rendered(frames[frame], dataclasses.replace(seen, K=K, width=side, height=side))
            found = float(psnr(shown[None].float() / 255, expected[None]))
            assert (shown.amax(2) > 20).float().mean() > 0.1 and found > 30, (frame, found)
        assert browser.value("document.getElementById('label').textContent") == "predicted"
        before = canvas_of(browser)
        browser.drag((3 * SIZE // 2, SIZE // 2), (3 * SIZE // 2 + 60, SIZE // 2 + 20))
        browser.wait("player.idle && player.painted[1] > 0")
        assert np.abs(before.astype(int) - canvas_of(browser)).mean() > 1
        assert not browser.complaints
        assert all(request.startswith((url, "blob:", "data:")) for request in browser.requests)


@browsing
def test_player_with_reduced_motion_loops_and_is_touched(tmp_path):
    """A red Gaussian before a large green one, seen where the camera projects them."""
    seen = view()
    red, green = ((torch.tensor(c) - 0.5) / SH_0 for c in ((0.9, 0.1, 0.1), (0.1, 0.7, 0.2)))
    toward = -torch.from_numpy(seen.viewmat[2, :3]).float()
    pair = dataclasses.replace(
        make(2, 0),
        means=torch.stack([torch.tensor([0.0, 0, 0.5]) + 0.5 * toward, torch.tensor([0.0, 0, 0.5])]),
        scales=torch.tensor([[0.06] * 3, [0.25] * 3]),
        opacities=torch.tensor([0.99, 0.99]),
        sh=torch.stack([red, green])[:, None],
    )
    write_player(tmp_path / "a.html", [pair] * 3, fps=FPS, view=seen)
    with Browser(SIZE, SIZE, "--force-prefers-reduced-motion") as browser:
        browser.open((tmp_path / "a.html").as_uri())
        browser.wait("globalThis.player && player.painted !== null")
        assert not browser.value("player.playing") and browser.value("player.frame") == 0
        image = canvas_of(browser).astype(int)
        side, (y, x) = min(image.shape[:2]), (length // 2 for length in image.shape[:2])
        assert np.abs(image[y, x] - 255 * np.array([0.9, 0.1, 0.1])).max() < 8
        beside = image[y, x + side // 20]
        assert beside[1] > 120 and beside[0] < 80
        browser.press("l")  # no loop
        browser.press(" ")
        browser.wait("!player.playing && player.frame === 2")
        browser.press("l")
        browser.press(" ")
        browser.wait("player.playing && player.frame === 1")
        browser.press(" ")
        browser.press("Home")
        browser.wait("player.idle")
        near = (canvas_of(browser).max(2) > 60).sum()
        browser.touch([(140, 200), (220, 200)], [(130, 200), (230, 200)], [(80, 200), (280, 200)])
        browser.wait("player.idle")
        assert (canvas_of(browser).max(2) > 60).sum() > 1.5 * near
        before = canvas_of(browser).astype(int)
        browser.touch([(180, 200)], [(200, 180)], [(240, 180)])
        browser.wait("player.idle")
        assert np.abs(canvas_of(browser) - before).max() > 60 and not browser.complaints


@browsing
def test_player_compensates_antialiased_gaussians(tmp_path):
    seen, one = view(), torch.ones(1)
    small = make(400, 1)
    small = dataclasses.replace(small, scales=small.scales / 50, antialiased=True)
    write_player(tmp_path / "a.html", [small], fps=FPS, view=seen)
    with Browser(SIZE, SIZE) as browser:
        browser.open((tmp_path / "a.html").as_uri())
        browser.wait("globalThis.player && player.painted !== null && player.idle")
        image = canvas_of(browser)
        assert not browser.complaints
    side = min(image.shape[:2])
    top, left = ((length - side) // 2 for length in image.shape[:2])
    K = torch.from_numpy(seen.K * np.array([[side / SIZE], [side / SIZE], [1]]))[None].float()
    viewmat = torch.from_numpy(seen.viewmat)[None].float()
    camera = Cameras(viewmat, K, 0.1 * one, 20 * one, torch.tensor([0]), side, side)
    shown, expected = (
        torch.from_numpy(np.ascontiguousarray(x))[None].float() / 255
        for x in (image[top : top + side, left : left + side], picture(small, camera))
    )
    assert float(psnr(shown, expected)) > 35
    assert abs(float(shown.mean() / expected.mean()) - 1) < 0.05


@browsing
def test_player_without_webgl_shows_its_poster(tmp_path):
    frames = moving(2)
    write_player(tmp_path / "a.html", frames, fps=FPS, view=view())
    with Browser(SIZE, SIZE, "--disable-3d-apis") as browser:
        browser.open((tmp_path / "a.html").as_uri())
        browser.wait("document.getElementById('problem') && !document.getElementById('problem').hidden")
        assert "WebGL 2" in browser.value("document.getElementById('problem').textContent")
        assert browser.value("!poster.hidden && poster.naturalWidth") == POSTER


def canvas_of(browser) -> np.ndarray:
    """RGB image of the canvas."""
    url = browser.value("document.getElementById('view').toDataURL('image/png')")
    content = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    return cv2.imdecode(content, cv2.IMREAD_COLOR)[..., ::-1]
