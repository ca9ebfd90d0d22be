"""The live viewer: timeline, layers, colours, targets and edits without a browser; its server; Chromium."""

import asyncio
import dataclasses
import subprocess
import sys
import threading
import time
import types
import urllib.request

import numpy as np
import pytest
import torch

from gsim3d.cli.main import main
from gsim3d.effects.edits import Move, Recolor, Throw
from gsim3d.errors import InputError
from gsim3d.io import read_splats, write_ply, write_splats
from gsim3d.io.sequence import write_about
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, Gaussians
from gsim3d.viewer import server
from gsim3d.viewer.live import (
    ASLEEP_COLOR,
    AWAKE_COLOR,
    FROZEN_COLOR,
    Layers,
    Target,
    Timeline,
    splatting_of,
    unit_of,
)
from gsim3d.viewer.targets import open_target
from tests.test_simulator import SIZE
from tests.tiny_scenes import N_CAMS

pytestmark = pytest.mark.usefixtures("one_thread")
RED = (0.9, 0.1, 0.1)


def splats(means, color=RED) -> Gaussians:
    means = torch.tensor(means, dtype=torch.float32)
    n = len(means)
    sh = ((torch.tensor(color) - 0.5) / SH_0).expand(n, 1, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4)
    return Gaussians(means, quats, torch.full((n, 3), 0.1), torch.full((n,), 0.99), sh, torch.tensor([0, n]))


def falling(n_frames=4):
    return [splats([[0.0, 0.0, -0.1 * step], [1.0, 0.0, 0.0]]) for step in range(n_frames)]


def target_of(frames, **options) -> Target:
    return Target("falling", 10.0, frames=frames, **options)


def test_timeline_advances_at_its_speed_and_loops():
    timeline = Timeline(10, fps=20)
    assert not timeline.advance(1.0) and timeline.frame == 0
    timeline.play()
    assert timeline.advance(0.11) and timeline.frame == 2
    assert not timeline.advance(0.01)
    timeline.set_speed(0.5)
    timeline.advance(0.2)
    assert timeline.frame == 4
    timeline.advance(0.6)
    assert timeline.frame == 0 and timeline.playing


def test_timeline_stops_at_the_end_without_loop_and_starts_again():
    timeline = Timeline(4, fps=10)
    timeline.loop = False
    timeline.play()
    timeline.advance(9.0)
    assert timeline.frame == 3 and not timeline.playing
    timeline.play()
    assert timeline.frame == 0 and timeline.playing
    timeline.pause()
    assert not timeline.advance(1.0)


def test_timeline_resize_keeps_the_frame_where_it_exists():
    timeline = Timeline(10, fps=10)
    timeline.seek(7)
    timeline.resize(9)
    assert timeline.frame == 7
    timeline.resize(3)
    assert timeline.frame == 2


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: Timeline(0, 10), "at least one frame"),
        (lambda: Timeline(3, float("nan")), "fps"),
        (lambda: Timeline(3, 10).seek(3), "frame 3: there are 3"),
        (lambda: Timeline(3, 10).set_speed(0.0), "speed must be from"),
        (lambda: Layers(coloring="velocit"), "did you mean velocity"),
        (lambda: Layers(size=0.0), "size must be from"),
        (lambda: target_of(falling()).seen(0, Layers(coloring="latents")), "no colours by latents"),
    ],
)
def test_wrong_values_are_named(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_velocity_colors_what_moved():
    target = target_of(falling())
    assert target.colorings == ("appearance", "velocity")
    colors = target.colors(2, "velocity")
    assert not torch.equal(colors[0], colors[1])
    assert torch.equal(target.colors(0, "velocity")[0], colors[1])
    assert target.displacements(3)[0].tolist() == pytest.approx([0, 0, -0.1])


def test_frames_with_other_particles_have_no_velocity():
    frames = falling()
    frames[2] = splats([[5.0, 0.0, 0.0]])
    assert target_of(frames).displacements(2).abs().max() == 0
    assert target_of(falling(), n_encoded=3).displacements(2).abs().max() == 0


def test_single_frame_has_appearance_alone():
    assert target_of(falling(1)).colorings == ("appearance",)


def test_size_and_coloring_change_what_is_seen_and_exported(tmp_path):
    target = target_of(falling())
    layers = Layers(coloring="velocity", size=0.5)
    out = tmp_path / "seen.ply"
    assert f"{out}: 2 Gaussians" in target.export(out, [2], layers)
    written = read_splats(out)
    torch.testing.assert_close(written.scales, torch.full((2, 3), 0.05))
    torch.testing.assert_close(0.5 + SH_0 * written.sh[:, 0], target.colors(2, "velocity"))
    with pytest.raises(InputError, match="exists already"):
        target.export(out, [2], layers)
    with pytest.raises(InputError, match="no format"):
        target.export(tmp_path / "seen.txt", [2], layers)


@pytest.mark.parametrize("scale", [1e-4, 0.01, 30.0])
def test_splatting_has_covariances_that_half_precision_holds(scale):
    gaussians = dataclasses.replace(splats([[1.0, 2.0, 3.0]]), scales=torch.tensor([[1.0, 2.0, 3.0]]) * scale)
    unit = unit_of(gaussians)
    centers, covariances, rgbs, _ = splatting_of(gaussians, unit)
    expected = np.diag([1.0, 4.0, 9.0]) * scale**2
    held = covariances[0].astype(np.float16).astype(np.float64)
    np.testing.assert_allclose(held * unit**2, expected, rtol=1e-3)
    np.testing.assert_allclose(centers[0] * unit, [1, 2, 3], rtol=1e-6)
    np.testing.assert_allclose(rgbs[0], RED, rtol=1e-5)


def test_scene_shows_its_cameras_and_images(scene):
    target = open_target(scene, start=1)
    assert target.n_frames == 5 and target.gaussians(0) is None and target.colorings == ("appearance",)
    views = target.views(0, range(N_CAMS))
    assert [view.image.shape for view in views] == [(SIZE, SIZE, 3)] * N_CAMS
    assert np.linalg.norm(views[0].position[:2]) == pytest.approx(2.5)
    assert views[0].fov == pytest.approx(2 * np.arctan(0.5 / 1.3))
    assert target.beside(0, 0, Layers()).shape == (SIZE, SIZE, 3)
    with pytest.raises(InputError, match="holds no Gaussians"):
        target.export("a.ply", [0], Layers())


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "run" / "gaussians"
    folder.mkdir(parents=True)
    for step, frame in enumerate(falling()):
        write_ply(folder / f"step_{step:04d}.ply", frame)
    write_about(folder, 42.0)
    return tmp_path / "run"


def test_run_is_opened_with_its_rate_and_the_truth_beside_it(run, scene):
    target = open_target(run)
    assert (target.n_frames, target.fps, target.scene) == (4, 42.0, None)
    assert (
        open_target(run / "gaussians").n_frames == 4 and open_target(run / "gaussians" / "step_0001.ply").n_frames == 1
    )
    target = open_target(run, scene=scene, start=4)
    pair = target.beside(1, 0, Layers())
    assert pair.shape == (SIZE, 2 * SIZE, 3) and pair[:, :SIZE].any() and pair[:, SIZE:].any()
    assert not target.beside(2, 0, Layers())[:, :SIZE].any()
    assert target.views(3, [0])[0].image is None


@pytest.mark.parametrize(
    "options, message",
    [
        ({"target": "none"}, "no such file or folder"),
        ({"target": "run", "start": 2}, "without --scene"),
        ({"target": "run", "scene": "scene", "start": 6}, "--start 6: .* 6 steps"),
        ({"target": "scene", "up": "y"}, "--scene and --up belong"),
        ({"target": "."}, r"no file of Gaussians \(of a data set, view a scene\)"),
    ],
)
def test_open_target_names_what_is_wrong(options, message, run, scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {key: {"run": run, "scene": scene}.get(value, value) for key, value in options.items()}
    with pytest.raises(InputError, match=message):
        open_target(**options)


def test_simulation_has_encoded_and_predicted_frames(simulation):
    target = simulation.target
    assert (target.n_frames, target.n_encoded) == (5, 2) and simulation.seconds_a_step > 0
    assert target.colorings == ("appearance", "velocity", "activity", "latents")
    for frame in (0, 4):
        for coloring in target.colorings[1:]:
            colors = target.colors(frame, coloring)
            assert colors.shape == target.gaussians(frame).means.shape and 0 <= colors.min() <= colors.max() <= 1


def test_activity_colors_and_layers_follow_the_particles(simulation):
    target = simulation.target
    particles = target.particles[1]
    activity = torch.full_like(particles.activity, DYNAMIC)
    activity[:2], activity[2] = FROZEN, ASLEEP
    target.replace([dataclasses.replace(particles, activity=activity)])
    colors = target.colors(0, "activity")
    for row, color in ((0, FROZEN_COLOR), (2, ASLEEP_COLOR), (3, AWAKE_COLOR)):
        assert colors[row].tolist() == pytest.approx(color)
    count = len(activity)
    seen = [target.seen(0, Layers(moving=moving, frozen=not moving)) for moving in (True, False)]
    assert [len(one.means) for one in seen] == [count - 2, 2]
    assert len(target.seen(0, Layers(moving=False, frozen=False)).means) == 0


def test_viewer_is_not_imported_before_it_is_asked_for():
    code = "import gsim3d, gsim3d.viewer, gsim3d.viewer.server, sys; assert 'viser' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_missing_viser_says_how_to_install_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "a.ply"]) == 2
    assert "pip install 'gsim3d[viewer]'" in capsys.readouterr().err


def test_server_answers_on_a_free_port_and_gives_it_back(viser):
    with server.Viewer(target_of(falling())) as viewer:
        assert viewer.address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(viewer.address) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
        port = int(viewer.address.rpartition(":")[2])
        with pytest.raises(InputError, match=f"--port {port}"):
            server.free_port("127.0.0.1", port)
        viewer.timeline.play()
        end = time.monotonic() + 10
        while viewer.timeline.frame == 0 and time.monotonic() < end:
            time.sleep(0.02)
        assert viewer.timeline.frame > 0
    assert server.free_port("127.0.0.1", port) == port


class Clicks:
    """Presses what a viewer listens to, as a browser's message does."""

    def __init__(self):
        self.said = []
        self._client = types.SimpleNamespace(add_notification=lambda *args, **_: self.said.append(args))

    def on_click(self, call):
        self.call = call

    def __call__(self):
        asyncio.run(self.call(types.SimpleNamespace(client=self._client)))


def until(condition):
    end = time.monotonic() + 30
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()


def test_viewer_simulates_on_from_the_frame_that_is_shown(viser, simulation):
    with server.Viewer(simulation.target, simulation) as viewer:
        viewer.timeline.seek(2)
        viewer.simulate_on(2, 6, Move("all", (0.0, 0.0, 0.1)), simulation.effects)
        assert viewer.timeline.n_frames == 9 and viewer.timeline.frame == 2


def test_clicks_during_a_simulation_are_done_in_order_as_they_were_meant(viser, simulation, monkeypatch):
    may_go, predicted, asked = threading.Event(), simulation.predicted, []

    def slowly(frame, n_steps, operations, effects):
        asked.append((frame, n_steps, list(operations), effects.dynamics.history))
        may_go.wait(30)
        return predicted(frame, n_steps, operations, effects)

    monkeypatch.setattr(simulation, "predicted", slowly)
    with server.Viewer(simulation.target, simulation) as viewer:
        panel, click = viewer._panel, Clicks()
        viewer.on(click, panel._simulate, "on_click")
        viewer.timeline.seek(2)
        panel._steps.value = 3
        for edit, up in (("move", 0.5), ("throw", 0.25), ("move", 0.5), ("move", 0.75)):
            panel._edit.value, panel._vector.value = edit, (0.0, 0.0, up)
            click()
        simulation.choose("history", "1 step")
        viewer.timeline.seek(3)
        panel._edit.value = "recolor"
        click()
        panel._edit.value, panel._vector.value = "none", (0.0, 0.0, 9.0)
        simulation.choose("history", "2 steps")
        until(lambda: "at work (5 to do)" in viewer._status.content)
        assert viewer.timeline.n_frames == 5 and simulation.edits == ()
        may_go.set()
        until(lambda: "at work" not in viewer._status.content)
        move, last = (Move("moving", (0.0, 0.0, up)) for up in (0.5, 0.75))
        throw, red = Throw("moving", (0.0, 0.0, 0.25)), Recolor("moving", (220 / 255, 40 / 255, 40 / 255))
        assert [one[2] for one in asked[:4]] == [[move], [move, throw], [throw, move], [throw, last]]
        assert asked[4] == (3, 3, [red], 1) and asked[0][3] == 2
        assert [(edit.step, edit.operation) for edit in simulation.edits] == [(1, throw), (1, last), (2, red)]
        assert viewer.timeline.n_frames == 7 and not click.said


def test_closing_ends_a_long_simulation_after_its_step(viser, simulation):
    with server.Viewer(simulation.target, simulation) as viewer:
        click = Clicks()
        viewer._panel._steps.value = 1_000_000
        viewer.on(click, viewer._panel._simulate, "on_click")
        click()
        until(lambda: "at work" in viewer._status.content)
        began = time.monotonic()
    assert time.monotonic() - began < 20 and "closed" in click.said[0][1] and simulation.target.n_frames == 5


def test_what_fails_in_the_clock_is_shown_and_stops_time(viser, tmp_path, capsys):
    for step, frame in enumerate(falling()):
        write_splats(tmp_path / f"step_{step}.ply", frame)
    (tmp_path / "step_2.ply").write_bytes(b"ply")
    with server.Viewer(open_target(tmp_path)) as viewer:
        click = Clicks()
        viewer.server.get_clients = lambda: {0: click._client}
        viewer.timeline.play()
        until(lambda: click.said)
        assert "step_2.ply" in click.said[0][1] and not viewer.timeline.playing and viewer._play.label == "Play"
        viewer.timeline.seek(3)
        viewer.on(click, lambda: None, "on_click")
        click()
        until(lambda: "frame 3 of 4" in viewer._status.content)
        viewer.on(click, lambda: 1 / 0, "on_click")
        click()
        assert "ZeroDivisionError" in click.said[1][1]
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_errors_of_files_are_shown_and_a_home_is_meant(viser, simulation, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "file").touch()
    with server.Viewer(simulation.target, simulation) as viewer:
        click = Clicks()
        viewer.on(click, lambda: viewer._export("~/seen.ply", False), "on_click")
        click()
        until(lambda: click.said)
        viewer.on(click, lambda: (tmp_path / "file" / "a.ply").touch(), "on_click")
        click()
    (title, what), (_, error) = click.said
    assert title == "Written" and str(tmp_path / "seen.ply") in what and (tmp_path / "seen.ply").is_file()
    assert "a.ply" in error


def test_view_command_prints_the_address_and_ends_with_ctrl_c(viser, run, scene, checkpoint, monkeypatch, capsys):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(server.Viewer, "wait", interrupt)
    assert main(["view", str(run), "--scene", str(scene)]) == 0
    out, err = capsys.readouterr()
    assert "run: 4 frames at http://127.0.0.1:" in out and "viser" not in out and not err
    assert main(["view", str(scene), "--checkpoint", str(checkpoint), "--steps", "2"]) == 0
    assert "4 frames" in capsys.readouterr().out
    for wrong in (["--steps", "2"], ["--checkpoint", str(checkpoint), "--fps", "3"]):
        assert main(["view", str(scene), *wrong]) == 2
