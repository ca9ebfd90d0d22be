"""Simulating on in the live viewer: edits, bodies, clicks, effects and their costs, states; without a browser."""

import dataclasses
import types

import numpy as np
import pytest
import torch

from gsim3d.cameras import InputSpec
from gsim3d.cli.main import main
from gsim3d.effects.edits import Duplicate, Move, Recolor, Remove, Throw
from gsim3d.errors import FitWarning, InputError
from gsim3d.io import read_particles, write_particles
from gsim3d.io.particles import STATE
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.numerics.trust import Trust
from gsim3d.state import FROZEN, CloudTable, concatenate
from gsim3d.train.restore import restore
from gsim3d.viewer import server
from gsim3d.viewer.bodies import with_bodies
from gsim3d.viewer.live import FROZEN_COLOR, Layers
from gsim3d.viewer.simulation import OfBody, Simulation, hit
from gsim3d.viewer.targets import open_state, open_target
from tests.effects.models import EXPLICIT_CONFIG
from tests.test_simulator import SIZE, awake, make_simulator
from tests.viewer.test_live import falling, splats
from tests.viewer.test_player import unpacked

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


def test_doubt_goes_on_with_the_simulation(checkpoint, scene):
    restored = restore(checkpoint)
    restored.simulator.trust = Trust(2, 3, 0.5, 1.0, (-9.0, 0.0), (0.9,), ((0.01, 0.1),), {}, 3.0)
    simulation = Simulation(restored, restored.open_scene(scene), 4)
    straight, last = simulation.spread(simulation.parts[0]), simulation.target.particles[-1].means
    simulation.simulate_on(3, 2)
    assert torch.equal(simulation.target.particles[-1].means, last)
    spread = simulation.spread(simulation.parts[-1])
    assert bool((spread >= straight[1]).all()) and spread[:, straight[1] > 0].mean() > straight[1].mean() > 0
    assert (simulation._bounds(4) >= simulation._bounds(3)).all()
    simulation.simulate_on(3, 2, [Duplicate("all", (0.0, 0.0, 1.0))])
    copied = simulation.spread(simulation.parts[-1])
    assert copied.shape[1] > spread.shape[1] and bool((copied >= straight[1].max()).all())


def test_bodies_are_found_and_boxes_hold_them_in_the_history(simulation):
    target = simulation.target
    for frame in (1, 3):
        particles = target.particles[frame]
        bodies = simulation.bodies(frame)
        rows = torch.cat(list(bodies.values())).sort().values
        assert torch.equal(rows, (particles.activity != FROZEN).nonzero()[:, 0])
        low, high = map(torch.tensor, simulation.box_of(frame, 0))
        means = particles.means[bodies[0]]
        assert bool(((means >= low) & (means <= high)).all())
        if frame == 3:  # rows of predicted steps are the same particles
            before = target.particles[2].means[bodies[0]]
            assert bool(((before >= low) & (before <= high)).all())
    target.replace([dataclasses.replace(particles, label=torch.full_like(particles.label, -1))])
    assert simulation.bodies(0) == {}


def cloth_and_ball(given, heights, seed=0):
    """Encoded steps: a square of 600 particles, and 60 of a ball at other heights above it."""
    steps, random = [], torch.Generator().manual_seed(seed)
    for step, height in enumerate(heights):
        square = torch.rand(600, 3, generator=random) * torch.tensor([2.0, 2.0, 0.0])
        ball = torch.randn(60, 3, generator=random)
        ball = torch.tensor([1.0, 1.0, height]) + 0.2 * ball / ball.norm(dim=1, keepdim=True)
        cloud = given.select_clouds([given.n_clouds - 1])
        some = (cloud.activity != FROZEN).nonzero()[:, 0][:1].repeat(660)
        fields = {name: values[some] for name, values in cloud.row_fields().items()}
        order = torch.randperm(660, generator=random)  # steps do not have the same particles
        fields |= {"means": torch.cat([square, ball])[order], "opacities": torch.full((660,), 0.9)}
        table = CloudTable.make([660], [0], [step], given.cu_rows.device)
        steps.append(cloud.with_clouds(table, **fields))
    return concatenate(steps), torch.cat([one.means[:, 2] > 0.05 for one in steps])


@pytest.mark.parametrize("heights", [(1.0, 0.8), (0.6, 0.12), (0.12, 0.6)], ids=["apart", "touches", "leaves"])
def test_bodies_of_all_given_steps_are_separated(simulation, heights):
    state, is_ball = cloth_and_ball(simulation._state, heights)
    state = dataclasses.replace(state, activity=state.activity.where(torch.arange(len(is_ball)) % 7 > 0, FROZEN))
    label = with_bodies(state).label
    assert bool((label[state.activity == FROZEN] == -1).all())
    moving = state.activity != FROZEN
    for found, of_ball in zip(label[moving].chunk(2), is_ball[moving].chunk(2), strict=True):
        assert ((found == 1) == of_ball).float().mean() > 0.95 and set(found.tolist()) == {0, 1}


@pytest.mark.parametrize("heights", [(2.0, 1.0), (1.0, 2.0)])
def test_pieces_that_a_single_step_lacks_are_no_bodies(simulation, heights):
    state, is_ball = cloth_and_ball(simulation._state, (*heights, 0.1))
    later = state.clouds.counts[0] * 2
    sparse = is_ball & (torch.arange(len(is_ball)) < later)  # nearly all of the ball is hidden in two of three steps
    sparse &= torch.arange(len(is_ball)) % 660 > 5
    assert set(with_bodies(state.select_rows(~sparse)).label.tolist()) == {0}


def test_an_edit_of_a_body_takes_nothing_else_of_its_box(simulation, checkpoint):
    state, is_ball = cloth_and_ball(simulation._state, (0.9, 0.7))
    simulation = Simulation(restore(checkpoint), state, 2)
    target = simulation.target
    frames = [one.label == 1 for one in target.particles]
    assert [int(one.sum()) for one in frames] == [60] * 4 and torch.equal(torch.cat(frames[:2]), is_ball)
    down = Move(OfBody("all", None, 1), (0.0, 0.0, -0.7))  # into the cloth
    simulation.simulate_on(1, 2, [down])
    history, before = simulation.parts[0].history, simulation._state.means
    assert torch.equal((history.means != before).any(1), is_ball)  # in every step that the model goes on from
    low, high = map(torch.tensor, simulation.box_of(2, 1))
    cloth = target.particles[2].means[target.particles[2].label == 0]
    assert ((cloth >= low) & (cloth <= high)).all(1).any()  # they overlap, and are still two
    simulation.simulate_on(2, 1, [Remove(OfBody("all", None, 1))])
    assert simulation.bodies(3).keys() == {0} and len(simulation.bodies(3)[0]) == 600
    simulation.simulate_on(2, 2, [Duplicate(OfBody("all", None, 1), (0.0, 0.0, 1.0))])
    assert {body: len(rows) for body, rows in simulation.bodies(4).items()} == {0: 600, 1: 60, 2: 60}
    simulation.simulate_on(4, 1, [Recolor(OfBody("all", None, 2), (1.0, 0.0, 0.0))])
    with pytest.raises(InputError, match="edit at step 3, move: the selection is empty: the box holds nothing of"):
        simulation.simulate_on(4, 1, [Move(OfBody("all", None, 3), (0.0, 0.0, 1.0))])


def test_edits_after_one_frame_add_up_and_repeated_ones_count_once(simulation):
    up, other = Move("all", (0.0, 0.0, 0.5)), Move("all", (0.0, 0.0, 0.25))
    red = Recolor("moving", (1.0, 0.0, 0.0))
    simulation.simulate_on(2, 2, simulation.operations(2, up))
    once = simulation.target.particles[3].means
    simulation.simulate_on(2, 2, simulation.operations(2, up))
    assert torch.equal(simulation.target.particles[3].means, once)
    assert simulation.operations(2, red) == [up, red] and simulation.operations(3, red) == [red]
    simulation.simulate_on(2, 2, [up, red])
    assert simulation.operations(2, other) == [red, other] and simulation.operations(2, None) == []


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
        panel._simulate()()
        assert viewer.timeline.n_frames == 5 and "ms a simulated step" in viewer._status.content
        assert panel._which.value.startswith("body 1") and panel._inside.value  # to try again with another vector
        (edit,) = simulation.edits
        assert isinstance(edit.operation, kind) and edit.step == 1 and edit.operation.of == OfBody("all", None, 0)
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
    target = simulation.target
    simulation.simulate_on(1, 2, [Duplicate("moving", (0.0, 0.0, 0.01))])
    with server.Viewer(target, simulation) as viewer:
        panel, given = viewer._panel, simulation.bodies(1)
        sizes = {body: len(rows) for body, rows in simulation.bodies(2).items()}
        assert list(sizes) == list(range(2 * len(given))) and sizes[0] == sizes[len(given)] == len(given[0])
        viewer.timeline.seek(2)
        viewer.draw()
        panel._which.value, panel._edit.value, panel._steps.value = panel._which.options[3 + len(given)], "remove", 2
        panel._choose()
        panel._simulate()()
        assert target.particles[3].n_rows == target.particles[2].n_rows - sizes.pop(len(given))
        assert {body: len(rows) for body, rows in simulation.bodies(4).items()} == sizes
        said = ["- frame 1: duplicate moving", f"- frame 2: remove body {len(given) + 1}"]
        assert panel._edits.content.splitlines() == said
        panel._middle.value = (90.0, 90.0, 90.0)
        with pytest.raises(InputError, match="the selection is empty"):
            panel._simulate()()


def test_panel_shows_what_effects_cost(viser, simulation):
    with server.Viewer(simulation.target, simulation) as viewer:
        viewer.timeline.seek(4)
        viewer._panel._measure()()
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


def test_players_of_what_is_seen_label_the_given_frames(simulation, tmp_path):
    for name, frames, start in (("all.html", range(5), 2), ("given.html", [1], 1), ("later.html", [3], 0)):
        simulation.target.export(tmp_path / name, frames, Layers())
        assert unpacked((tmp_path / name).read_text())[0]["start"] == start


@pytest.mark.parametrize("name, frames", [("all.html", 5), ("all.mp4", 5), ("one.splat", 1)])
def test_what_is_seen_is_exported_as_gsim3d_export_does(simulation, name, frames, tmp_path):
    said = simulation.target.export(tmp_path / name, range(frames), Layers(frozen=False))
    assert said.startswith(str(tmp_path / name)) and (tmp_path / name).stat().st_size > 500
    with pytest.raises(InputError, match="holds one frame, and there are 5"):
        simulation.target.export(tmp_path / "all.splat", range(5), Layers())
