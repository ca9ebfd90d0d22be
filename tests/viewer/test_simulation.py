"""Simulating on in the live viewer: edits, bodies, clicks, effects and their costs, states; without a browser."""

import dataclasses
import types

import numpy as np
import pytest
import torch

from gsim3d.cameras import InputSpec
from gsim3d.cli.main import main
from gsim3d.effects.edits import Duplicate, Move, Recolor, Remove, Throw
from gsim3d.effects.selection import newest_mask
from gsim3d.errors import FitWarning, InputError
from gsim3d.io import read_particles, write_particles
from gsim3d.io.particles import STATE
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.numerics.trust import Trust
from gsim3d.state import FROZEN, concatenate
from gsim3d.train.restore import restore
from gsim3d.viewer import server
from gsim3d.viewer.live import FROZEN_COLOR, Layers
from gsim3d.viewer.simulation import Simulation, hit
from gsim3d.viewer.targets import open_state, open_target
from tests.effects.models import EXPLICIT_CONFIG
from tests.test_simulator import SIZE, awake, make_simulator
from tests.viewer.test_live import falling, splats

pytestmark = pytest.mark.usefixtures("one_thread")


def simulated(checkpoint, scene, n_steps) -> Simulation:
    restored = restore(checkpoint)
    return Simulation(restored, restored.open_scene(scene), n_steps)


def test_simulate_on_equals_one_rollout_with_all_edits(simulation, checkpoint, scene):
    first = simulation.target.particles[2].means
    simulation.simulate_on(2, 2, [Move("all", (0.0, 0.0, 0.5))])
    simulation.simulate_on(3, 2, [Move("all", (0.0, 0.2, 0.0))])
    target = simulation.target
    assert target.n_frames == 6 and [edit.step for edit in simulation.edits] == [1, 2]
    assert torch.equal(target.particles[2].means, first)
    assert (target.particles[3].means - first)[:, 2].mean() > 0.3
    again = simulated(checkpoint, scene, 1)
    state, plan = again._state, again._simulator.plan(again.effects)
    with torch.no_grad():
        steps = again._simulator.rollout(state, 4, plan, edits=simulation.edits)
    assert torch.equal(target.particles[-1].means, steps[-1].means)
    simulation.simulate_on(1, 1)
    assert simulation.edits == () and target.n_frames == 3


def test_simulate_on_removes_inside_of_a_box_and_refuses_without_a_change(simulation):
    target, before = simulation.target, list(simulation.target.particles)
    with pytest.raises(InputError, match="edit at step 2, remove: the selection is empty"):
        simulation.simulate_on(3, 1, [simulation.operation("remove", "all", (0, 0, 0), ([90] * 3, [91] * 3))])
    with pytest.raises(InputError, match="frame 0 must be from 1 to 4"):
        simulation.simulate_on(0, 1)
    with pytest.raises(InputError, match="operation must be one of"):
        simulation.operation("explode", "all", (0, 0, 0))
    assert all(a is b for a, b in zip(target.particles, before, strict=True)) and simulation.edits == ()
    middle = target.particles[3].means.median(0).values.tolist()
    box = [x - 0.3 for x in middle], [x + 0.3 for x in middle]
    simulation.simulate_on(3, 1, [simulation.operation("remove", "all", (0, 0, 0), box)])
    assert isinstance(simulation.edits[0].operation, Remove)
    assert 0 < target.particles[-1].n_rows < target.particles[3].n_rows


def test_trust_colours_particles_by_the_bound_of_their_error(checkpoint, scene):
    restored = restore(checkpoint)
    restored.simulator.trust = Trust(2, 3, 0.5, 1.0, (-9.0, 0.0), (0.9,), ((0.01, 0.1),), {}, 3.0)
    simulation = Simulation(restored, restored.open_scene(scene), 3)
    target = simulation.target
    assert target.colorings[-1] == "trust"
    simulation.simulate_on(3, 2, [Move("all", (0.0, 0.0, 0.1))])
    bounds = [simulation._bounds(frame) for frame in range(target.n_frames)]
    assert not bounds[0].any() and not bounds[1].any() and 0 < bounds[2].max() < bounds[3].max() < bounds[5].max()
    colors, frozen = target.colors(5, "trust"), target.particles[5].activity == FROZEN
    assert colors.shape == (len(frozen), 3) and bool((colors[frozen] == torch.tensor(FROZEN_COLOR)).all())
    assert len(colors[~frozen].unique(dim=0)) > 1


def test_bodies_are_found_and_boxes_hold_them_in_the_history(simulation):
    target = simulation.target
    for frame in (1, 3):
        particles = target.particles[frame]
        bodies = simulation.bodies(frame)
        rows = torch.cat(bodies).sort().values
        assert torch.equal(rows, (particles.activity != FROZEN).nonzero()[:, 0])
        low, high = map(torch.tensor, simulation.box_of(frame, bodies[0]))
        means = particles.means[bodies[0]]
        assert bool(((means >= low) & (means <= high)).all())
        if frame == 3:  # rows of predicted steps are the same particles
            before = target.particles[2].means[bodies[0]]
            assert bool(((before >= low) & (before <= high)).all())
    known = [len(rows) for rows in simulation.bodies(1)]
    unknown = dataclasses.replace(target.particles[1], body=target.particles[1].means)  # as of steps before the newest
    target.replace([target.particles[0], unknown, *target.particles[2:]])
    assert [len(rows) for rows in simulation.bodies(1)] == known and known[0] > 1
    apart = dataclasses.replace(target.particles[3], body=target.particles[3].means.round())
    target.replace([*target.particles[:3], apart, *target.particles[4:]])
    sizes = [len(rows) for rows in simulation.bodies(3)]
    assert len(sizes) > 1 and sizes == sorted(sizes, reverse=True)
    target.replace([dataclasses.replace(apart, activity=torch.full_like(apart.activity, FROZEN))])
    assert simulation.bodies(0) == []


def test_bodies_that_touch_later_stay_two_and_a_small_one_is_no_part_of_a_cloth(simulation):
    target = simulation.target
    given = target.particles[1]
    many = (given.activity != FROZEN).nonzero()[:, 0][:1].repeat(640)
    fields = {name: values[many] for name, values in given.row_fields().items() if name != "body"}
    is_small = torch.arange(640) < 40
    square = torch.rand(640, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([2.0, 2.0, 0.0])
    means = square * (1 - 0.75 * is_small.float()[:, None])
    fallen = []
    for height in (1.0, 0.5, 0.0):
        fields["means"] = means + is_small[:, None] * torch.tensor([0.0, 0.0, height])
        cloud = dataclasses.replace(given, body=None)
        fallen.append(cloud.with_clouds(cloud.clouds.with_counts([640]), **fields))
    target.replace([target.particles[0], *fallen])
    for frame in (1, 2, 3):
        assert [len(rows) for rows in simulation.bodies(frame)] == [600, 40]


def test_a_ray_hits_the_nearest_gaussian_that_is_shown():
    gaussians = splats([[2.0, 0.0, 0.0], [4.0, 0.05, 0.0], [-3.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    every = torch.ones(4, dtype=torch.bool)
    assert hit(gaussians, every, (0, 0, 0), (2, 0, 0)) == 0
    assert hit(gaussians, every, (0, 0, 0), (-1, 0, 0)) == 2
    assert hit(gaussians, torch.tensor([False, True, True, True]), (0, 0, 0), (1, 0, 0)) == 1
    assert hit(gaussians, every, (0, 0, 0), (0, 0, 1)) is None
    faint = dataclasses.replace(gaussians, opacities=torch.tensor([0.01, 0.9, 0.9, 0.9]))
    assert hit(faint, every, (0, 0, 0), (1, 0, 0)) == 1


def test_switches_are_those_of_the_model_and_say_why_not(simulation):
    switches = {switch.name: switch for switch in simulation.switches()}
    history = switches["history"]
    assert list(history.settings) == ["1 step", "2 steps", "4 steps"] and history.now == "2 steps"
    for name, settings, refused in (("sleep", ["off", "exact"], "approx"), ("opacity_changes", ["off"], "on")):
        assert list(switches[name].settings) == settings and switches[name].why.startswith(f"{refused}: ")
    assert switches["priors"].now == "none" and "trained" in switches["priors"].why
    with pytest.raises(InputError, match="effect sleep: 'approx' is not possible; it has off, exact"):
        simulation.choose("sleep", "approx")
    dynamics = dataclasses.replace(simulation.effects.dynamics, history=3)
    simulation.effects = dataclasses.replace(simulation.effects, dynamics=dynamics)
    assert {switch.name: switch.now for switch in simulation.switches()}["history"] == "3 steps"


def test_explicit_models_switch_changing_opacities(scene, tmp_path):
    simulator = awake(make_simulator(EXPLICIT_CONFIG))
    simulator.inputs = InputSpec(history=2, context_views=2, image_size=(SIZE, SIZE), fps=12.0)
    restored = restore(simulator.save_pretrained(tmp_path / "model"))
    simulation = Simulation(restored, restored.open_scene(scene), 2)
    assert {switch.name: switch.now for switch in simulation.switches()}["opacity_changes"] == "on"
    simulation.choose("opacity_changes", "off")
    simulation.simulate_on(2, 2)
    steps = simulation.target.particles[2:]
    assert torch.equal(steps[0].opacities, steps[2].opacities) and not torch.equal(steps[0].means, steps[2].means)


def test_effects_count_from_the_next_part_on(simulation):
    target, before = simulation.target, list(simulation.target.particles)
    simulation.choose("background", "masked_out")
    simulation.choose("history", "1 step")
    assert {s.name: s.now for s in simulation.switches()}["history"] == "1 step"
    assert all(a is b for a, b in zip(target.particles, before, strict=True))
    simulation.simulate_on(3, 2)
    assert all(a is b for a, b in zip(target.particles[:4], before, strict=False))
    n_moving = int((before[3].activity != FROZEN).sum())
    assert [one.n_rows for one in target.particles[4:]] == [n_moving] * 2 and n_moving < before[3].n_rows


def test_costs_are_measured_for_each_setting(simulation):
    shares = []
    costs = simulation.costs(3, shares.append)
    wanted = [(s.name, label) for s in simulation.switches() if len(s.settings) > 1 for label in s.settings]
    assert [cost[:2] for cost in costs] == wanted and all(ms > 0 for *_, ms in costs)
    now = {switch.name: switch.now for switch in simulation.switches()}
    assert len({ms for name, label, ms in costs if now[name] == label}) == 1  # one spec, timed once
    assert shares == sorted(shares) and shares[-1] == 1
    assert simulation.target.n_frames == 5


def body_color(simulation, frame, rows):
    return (0.5 + SH_0 * simulation.target.gaussians(frame).sh[rows, 0]).mean(0)


@pytest.mark.parametrize(
    "name, kind", [("move", Move), ("throw", Throw), ("duplicate", Duplicate), ("recolor", Recolor)]
)
def test_panel_edits_the_body_that_is_chosen(viser, simulation, name, kind):
    target = simulation.target
    with server.Viewer(target, simulation) as viewer:
        panel = viewer._panel
        assert viewer.timeline.frame == viewer._frame.value == target.n_encoded - 1 > 0  # can be simulated on
        viewer.timeline.seek(2)
        viewer.draw()
        panel._which.value = panel._which.options[3]
        panel._choose()
        assert panel._inside.value and panel._box.visible
        panel._edit.value = name
        panel._show_fields()
        assert panel._vector.visible == (name != "recolor") and panel._color.visible == (name == "recolor")
        panel._vector.value, panel._color.value, panel._steps.value = (0.0, 1.5, 0.5), (255, 0, 0), 2
        rows, before = simulation.bodies(2)[0], target.particles[3]
        color = body_color(simulation, 3, rows)
        panel._simulate()
        assert viewer.timeline.n_frames == 5 and "ms a simulated step" in viewer._status.content
        assert panel._which.value.startswith("body 1") and panel._inside.value  # to try again with another vector
        (edit,) = simulation.edits
        assert isinstance(edit.operation, kind) and edit.step == 1 and edit.operation.of.box is not None
        if name == "move":
            shift = (target.particles[3].means - before.means)[rows].mean(0)
            assert shift.tolist() == pytest.approx([0, 1.5, 0.5], abs=0.2)
        if name == "duplicate":
            assert target.particles[3].n_rows == before.n_rows + len(rows)
        if name == "recolor":
            red = body_color(simulation, 3, rows)
            assert red[0] > color[0] and red[1] < color[1] and red[2] < color[2]


def test_a_click_chooses_a_body_or_the_background_until_another_frame_is_shown(viser, simulation):
    target = simulation.target
    with server.Viewer(target, simulation) as viewer:
        panel = viewer._panel
        viewer.timeline.seek(3)
        viewer.draw()

        def click(rows):
            point = target.particles[3].means[rows][0].double().numpy()
            origin = point + np.array([0.0, 0.0, 3.0])
            panel._pick(types.SimpleNamespace(ray_origin=tuple(origin), ray_direction=tuple(point - origin)))

        body = simulation.bodies(3)[0]
        click(body[target.particles[3].means[body, 2].argmax()][None])
        assert panel._which.value.startswith("body 1") and panel._inside.value
        viewer.timeline.seek(2)
        viewer.draw()
        assert panel._which.value == "moving" and not panel._inside.value and not panel._box.visible
        viewer.timeline.seek(3)
        viewer.layers = Layers(moving=False)
        click(target.particles[3].activity == FROZEN)
        assert panel._which.value == "frozen" and not panel._inside.value
        panel._pick(types.SimpleNamespace(ray_origin=(50.0, 0.0, 50.0), ray_direction=(0.0, 0.0, 1.0)))
        assert panel._which.value == "frozen"
        panel._which.value = panel._which.options[3]
        viewer.timeline.play()
        for act in (panel._choose, panel._simulate):
            with pytest.raises(InputError, match="pause"):
                act()


def test_panel_edits_one_of_two_bodies_that_overlap(viser, simulation):
    target, state = simulation.target, simulation._state
    body = torch.zeros_like(state.means)
    simulation._state = dataclasses.replace(state, body=body.where(~newest_mask(state)[:, None], body + 1))
    simulation.simulate_on(1, 2, [Duplicate("moving", (0.0, 0.0, 0.01))])
    with server.Viewer(target, simulation) as viewer:
        panel, sizes = viewer._panel, [len(rows) for rows in simulation.bodies(2)]
        assert len(sizes) == 2 and sizes[0] == sizes[1]
        viewer.timeline.seek(2)
        viewer.draw()
        panel._which.value, panel._edit.value, panel._steps.value = panel._which.options[4], "remove", 2
        panel._choose()
        panel._simulate()
        assert target.particles[3].n_rows == target.particles[2].n_rows - sizes[1]
        assert [len(rows) for rows in simulation.bodies(4)] == sizes[:1]
        panel._middle.value = (90.0, 90.0, 90.0)
        with pytest.raises(InputError, match="the selection is empty"):
            panel._simulate()


def test_panel_shows_what_effects_cost(viser, simulation):
    with server.Viewer(simulation.target, simulation) as viewer:
        viewer.timeline.seek(4)
        viewer._panel._measure()
        lines = viewer._panel._costs.content.splitlines()
        assert lines[0] == "| effect | setting | ms a step |" and any("| history | 2 steps (on) |" in x for x in lines)
        assert not viewer._panel._progress.visible


@pytest.fixture
def state(simulation, checkpoint, tmp_path):
    digest = restore(checkpoint).checkpoint.digest
    write_particles(tmp_path / STATE, concatenate(simulation.target.particles[-2:]), digest)
    return tmp_path / STATE


def test_simulation_goes_on_from_a_state(state, simulation, checkpoint):
    restored = restore(checkpoint)
    again = Simulation(restored, open_state(state, restored), 2)
    assert again.target.n_encoded == 2 and torch.equal(
        again.target.particles[1].means, simulation.target.particles[4].means
    )
    simulation.simulate_on(4, 2)
    assert torch.equal(again.target.particles[-1].means, simulation.target.particles[-1].means)
    assert again.target.scene is None and again.target.beside(0, 0, Layers()) is None


def test_run_that_simulate_wrote_is_viewed_and_gone_on_with(viser, scene, checkpoint, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(server.Viewer, "wait", lambda _: None)
    run = tmp_path / "run"
    assert main(["simulate", str(checkpoint), str(scene), "--out", str(run), "--steps", "2", "--quiet"]) == 0
    assert main(["view", str(run)]) == 0 and main(["view", str(run), "--checkpoint", str(checkpoint)]) == 0
    assert main(["view", str(run / STATE), "--checkpoint", str(checkpoint), "--steps", "3"]) == 0
    out, err = capsys.readouterr()
    assert [line.split(" frames")[0] for line in out.splitlines()[1:]] == ["run: 4", "state: 16", "state: 7"], out
    assert not err
    assert main(["view", str(run / STATE)]) == 2 and "--checkpoint" in capsys.readouterr().err
    assert main(["view", str(run), "--checkpoint", str(checkpoint), "--start", "1"]) == 2


def test_damaged_states_are_named(state, simulation, tmp_path):
    particles, model = read_particles(state)
    wrong = {
        "not finite": dataclasses.replace(particles, means=torch.full_like(particles.means, torch.nan)),
        "dynamic_latents must be": dataclasses.replace(particles, dynamic_latents=particles.dynamic_latents[1:]),
        "cu_rows must ascend": dataclasses.replace(particles, cu_rows=particles.cu_rows + 1),
        "single number": dataclasses.replace(particles, cloud_step=torch.tensor(3)),
        "one scene": dataclasses.replace(particles, origin=particles.origin.repeat(2, 1)),
    }
    for message, value in wrong.items():
        write_particles(tmp_path / "wrong.safetensors", value, model)
        with pytest.raises(InputError, match=message):
            read_particles(tmp_path / "wrong.safetensors")
    content, rng = state.read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        flipped = bytearray(content)
        for place in rng.integers(0, min(len(content), 2000), 3):
            flipped[place] = rng.integers(256)
        (tmp_path / "wrong.safetensors").write_bytes(flipped[: rng.integers(1, len(flipped) + 1)])
        try:
            read_particles(tmp_path / "wrong.safetensors")
        except InputError as error:
            assert "wrong.safetensors" in str(error)


def test_state_of_another_checkpoint_is_warned_of(state, checkpoint):
    particles, _ = read_particles(state)
    write_particles(state, particles, "another")
    with pytest.warns(FitWarning, match="another checkpoint"):
        open_state(state, restore(checkpoint))
    with pytest.raises(InputError, match="static_latents must be"):
        write_particles(state, dataclasses.replace(particles, static_latents=particles.static_latents[:, :1]))
        open_state(state, restore(checkpoint))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".spz", ".glb"])
def test_folders_of_every_format_are_opened(suffix, tmp_path):
    from gsim3d.io import write_splats

    for step, frame in enumerate(falling()):
        write_splats(tmp_path / f"step_{step}{suffix}", frame)
    target = open_target(tmp_path)
    assert target.n_frames == 4 and target.seen(3, Layers()).means[:, 2].min() == pytest.approx(-0.3, abs=1e-2)
    assert open_target(tmp_path / f"step_2{suffix}").n_frames == 1


@pytest.mark.parametrize("name, frames", [("all.html", 5), ("all.mp4", 5), ("one.splat", 1)])
def test_what_is_seen_is_exported_as_gsim3d_export_does(simulation, name, frames, tmp_path):
    said = simulation.target.export(tmp_path / name, range(frames), Layers(frozen=False))
    assert said.startswith(str(tmp_path / name)) and (tmp_path / name).stat().st_size > 500
    with pytest.raises(InputError, match="holds one frame, and there are 5"):
        simulation.target.export(tmp_path / "all.splat", range(5), Layers())
