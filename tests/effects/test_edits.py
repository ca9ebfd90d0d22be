"""Edits: operations on states, edits within rollouts, and error messages."""

import dataclasses
import math

import pytest
import torch
import yaml

from gsim3d.dynamics import RestLog
from gsim3d.effects.edits import (
    Duplicate,
    Edit,
    Insert,
    Move,
    Recolor,
    Remove,
    Rotate,
    Selection,
    Throw,
    load_edits,
)
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep, StructureEffects
from gsim3d.errors import InputError
from gsim3d.priors import InertiaConfig, ShapeMatchingConfig
from gsim3d.state import DYNAMIC, FROZEN, VELOCITIES, append_step, last_steps, with_attribute
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.effects.models import MODELS
from tests.priors.scenes import OCCLUSION
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator, target_cameras

pytestmark = pytest.mark.usefixtures("one_thread")

EDITABLE = EffectsSpec(structure=StructureEffects(insert=True, remove=True))
CONFIGS = {name: MODELS[name] for name in ("latent", "explicit")}


def encoded(config=CONFIG, steps=(2,)):
    simulator, frames = awake(make_simulator(config)), make_frames(steps)
    with torch.no_grad():
        return simulator, simulator.encode(frames), frames


def edited(simulator, state, *operations):
    with torch.no_grad():
        for operation in operations:
            state = operation.apply(state, simulator._colors)
    return state


def future(simulator, state, n_steps, edits=(), spec=EDITABLE):
    with torch.no_grad():
        return simulator.rollout(state, n_steps, simulator.plan(spec), edits=edits)


def image(simulator, state, frames):
    with torch.no_grad():
        return simulator.render(last_steps(state, 1), target_cameras(frames, len(frames.origin)))


def test_remove_background():
    simulator, state, _ = encoded()
    without = state.select_rows(state.activity != FROZEN)
    steps = future(simulator, state, 3, [Edit(0, Remove("frozen"))])
    for step, expected in zip(steps, future(simulator, without, 3), strict=True):
        assert_same_bits(step.means, expected.means)
        assert_same_bits(step.dynamic_latents, expected.dynamic_latents)


def test_move_background():
    simulator, state, _ = encoded()
    raised = edited(simulator, state, Move("frozen", (0.0, 0.0, 0.25)))
    frozen = state.activity == FROZEN
    assert_close_relative_to_max(raised.means[frozen], state.means[frozen] + torch.tensor([0, 0, 0.25]), 1e-6)
    assert_same_bits(raised.means[~frozen], state.means[~frozen])


def test_move_keeps_velocity():
    simulator, state, _ = encoded()
    by = (0.5, -0.25, 0.125)
    moved = edited(simulator, state, Move("moving", by))
    moving = state.activity == DYNAMIC
    assert_close_relative_to_max(
        (moved.means - state.means)[moving], torch.tensor([by]).expand(int(moving.sum()), 3), 1e-5
    )
    assert len(set(state.row_cloud()[moving].tolist())) == 2, "the past moved as well"


def test_duplicate():
    simulator, state, _ = encoded(CONFIG, (2, 1))
    double = edited(simulator, state, Duplicate("moving", (1.0, 0.0, 0.0)))
    for q in range(state.n_clouds):
        one, two = state.select_clouds([q]), double.select_clouds([q])
        moving = one.activity == DYNAMIC
        assert_same_bits(two.means[: one.n_rows], one.means)
        assert_close_relative_to_max(two.means[one.n_rows :], one.means[moving] + torch.tensor([1.0, 0, 0]), 1e-6)
        assert_same_bits(two.static_latents[one.n_rows :], one.static_latents[moving])
    step = future(simulator, state, 1, [Edit(0, Duplicate("moving", (1.0, 0.0, 0.0)))])[0]
    assert step.n_rows == last_steps(double, 1).n_rows


@pytest.mark.parametrize("model", CONFIGS)
def test_rotate_matches_rotated_camera(model):
    """Positions, shapes and view-dependent colours turn; a quarter turn and an odd one."""
    simulator, state, frames = encoded(CONFIGS[model], (1,))
    before = image(simulator, state, frames)
    for degrees in (90.0, 33.0):
        turned = edited(simulator, state, Rotate("all", axis=(0.0, 0.0, 2.0), degrees=degrees, about=(0.0, 0.0, 0.0)))
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        back = torch.tensor([[c, s, 0, 0], [-s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        cameras = target_cameras(frames, 1)
        cameras = dataclasses.replace(cameras, viewmats=cameras.viewmats @ back)
        with torch.no_grad():
            after = simulator.render(turned, cameras)
        assert before.alpha.max() > 0.3
        # One splat whose alpha crosses 1/255 moves one pixel by 0.004.
        assert (after.color - before.color).square().mean().sqrt() < 1e-3
        assert not torch.allclose(turned.means, state.means, atol=0.1)


def test_rotate_pivot_and_velocity():
    simulator, state, _ = encoded(CONFIG, (2, 2))
    turned = edited(simulator, state, Rotate("moving", axis=(1.0, 0.0, 0.0), degrees=90.0))
    for scene in (0, 1):
        olds, news = ([s.select_clouds([2 * scene + t]) for t in (0, 1)] for s in (state, turned))
        middle, frozen = ([c.means[c.activity == kind].mean(0) for c in (*olds, *news)] for kind in (DYNAMIC, FROZEN))
        assert_close_relative_to_max(middle[3], middle[1], 1e-5)
        way, turned_way = middle[0] - middle[1], middle[2] - middle[3]
        assert_close_relative_to_max(turned_way, torch.stack([way[0], -way[2], way[1]]), 1e-4)
        assert_same_bits(frozen[3], frozen[1])


def test_throw_adds_velocity():
    simulator, state, _ = encoded(CONFIG, (3, 2))
    velocity = torch.tensor([0.03, 0.0, -0.02])
    for name in VELOCITIES:
        state = with_attribute(state, name)
    thrown = edited(simulator, state, Throw("moving", tuple(velocity.tolist())))
    moving = state.activity == DYNAMIC
    ages = torch.tensor([2, 1, 0, 1, 0])[state.row_cloud()][moving, None]
    assert_close_relative_to_max((state.means - thrown.means)[moving], ages * velocity, 1e-4)
    assert_same_bits(thrown.means[~moving], state.means[~moving])
    for known in (thrown.velocity, thrown.mean_velocity):
        assert_close_relative_to_max(known[moving], velocity.expand(int(moving.sum()), 3), 1e-6)
        assert not known[~moving].any()
    with pytest.raises(InputError, match="edit at step 4, throw: a history of one step has no velocity"):
        one = EffectsSpec(dynamics=DynamicsEffects(history=1))
        future(simulator, state, 5, [Edit(4, Throw("moving", (1.0, 0.0, 0.0)))], one)
    with pytest.raises(InputError, match="edit at step 0, throw: frozen particles cannot be thrown"):
        future(simulator, state, 1, [Edit(0, Throw("all", (1.0, 0.0, 0.0)))])


@pytest.mark.parametrize("model", CONFIGS)
def test_recolor_changes_appearance_only(model):
    simulator, state, frames = encoded(CONFIGS[model], (2,))
    red = edited(simulator, state, Recolor("moving", (0.8, 0.1, 0.1)))
    newest, moving = last_steps(red, 1), last_steps(red, 1).activity == DYNAMIC
    with torch.no_grad():
        colors, before = simulator._colors(newest), simulator._colors(last_steps(state, 1))
    assert_close_relative_to_max(colors[moving].mean(0), torch.tensor([0.8, 0.1, 0.1]), 0.02)
    assert_close_relative_to_max(colors[~moving], before[~moving], 1e-6)
    plain, painted = image(simulator, state, frames), image(simulator, red, frames)
    assert_same_bits(painted.alpha, plain.alpha)
    assert not torch.allclose(painted.color, plain.color, atol=0.01)
    if model == "latent":
        for step, other in zip(future(simulator, red, 2), future(simulator, state, 2), strict=True):
            assert_same_bits(step.means, other.means)
            assert_same_bits(step.dynamic_latents, other.dynamic_latents)
            assert step.color_transform is not None


def test_insert_merges_scenes():
    simulator, both, _ = encoded(CONFIG, (2, 2))
    here, there = both.select_clouds([0, 1]), both.select_clouds([2, 3])
    merged = edited(simulator, here, Insert("all", there, by=(0.5, 0.0, 0.0)))
    assert merged.n_clouds == 2 and merged.n_rows == both.n_rows
    for q in (0, 1):
        one, more, all_rows = (p.select_clouds([q]) for p in (here, there, merged))
        assert_same_bits(all_rows.means[: one.n_rows], one.means)
        assert_close_relative_to_max(all_rows.means[one.n_rows :], more.means + torch.tensor([0.5, 0, 0]), 1e-6)
    painted = edited(simulator, here, Recolor("moving", (1.0, 0.0, 0.0)), Insert("all", there))
    assert_same_bits(painted.color_transform[-1], torch.eye(3))
    assert future(simulator, here, 2, [Edit(1, Insert("moving", there))])[-1].n_rows > last_steps(here, 1).n_rows
    other, foreign, _ = encoded(MODELS["explicit"], (1,))
    with pytest.raises(InputError, match="edit at step 0, insert: particles.quats differs in shape"):
        future(simulator, here, 1, [Edit(0, Insert("all", foreign))])
    with pytest.raises(InputError, match="edit at step 0, insert: particles must be of a single scene"):
        future(simulator, here, 1, [Edit(0, Insert("all", both))])


@pytest.mark.parametrize(("model", "policy"), [("latent", None), ("latent", "exact"), ("asymmetric", "approx")])
def test_edit_within_rollout_matches_edited_state(model, policy):
    """Also with a cached background, and with sleep."""
    simulator, state, _ = encoded(MODELS[model])
    sleep = DynamicsEffects(sleep=None if policy is None else Sleep(policy, eps=0.5))
    spec = dataclasses.replace(EDITABLE, dynamics=sleep)
    edits = [
        Edit(2, Duplicate("moving", (0.4, 0.0, 0.0))),
        Edit(2, Remove(Selection("frozen", ((-9.0, -9.0, -9.0), (0.0, 9.0, 9.0))))),
        Edit(2, Move("frozen", (0.0, 0.0, 0.2))),
    ]
    steps = future(simulator, state, 4, edits, spec)
    plain = future(simulator, state, 2, spec=spec)
    middle = append_step(append_step(state, plain[0], 4), plain[1], 4)
    rest = future(simulator, edited(simulator, middle, *[edit.operation for edit in edits]), 2, spec=spec)
    assert [step.cloud_step.tolist() for step in steps] == [[2], [3], [4], [5]]
    for step, expected in zip(steps, [*plain, *rest], strict=True):
        assert_same_bits(step.means, expected.means)


def test_edit_wakes_sleeping_scene():
    simulator, state, _ = encoded()
    spec = dataclasses.replace(EDITABLE, dynamics=DynamicsEffects(sleep=Sleep("exact", eps=1e6, patience=1)))
    log, edit = RestLog(), Edit(8, Throw("moving", (0.0, 0.0, 0.05)))
    with torch.no_grad():
        simulator.rollout(state, 10, simulator.plan(spec), edits=[edit], log=log)
    assert log.moving[7] == 0 < log.moving[8], "asleep after as many steps as the model sees, until it is thrown"


def test_selection_box():
    _, state, _ = encoded()
    means = last_steps(state, 1).means
    middle = means.median(0).values.tolist()
    rows = Selection("all", ((-9.0, -9.0, -9.0), (middle[0], 9.0, 9.0))).mask(state)
    assert torch.equal(rows, state.means[:, 0] <= middle[0]) and 0 < int(rows.sum()) < state.n_rows
    with pytest.raises(InputError, match=r"no particle is moving in the box \[\[8.0, 8.0, 8.0\]"):
        Selection("moving", ((8.0, 8.0, 8.0), (9.0, 9.0, 9.0))).mask(state)


@pytest.mark.parametrize(
    ("edit", "spec", "message"),
    [
        (Edit(1, Remove("frozen")), EffectsSpec(), "edit at step 1, remove: the plan has structure.remove off"),
        (Edit(1, Duplicate()), EffectsSpec(), "edit at step 1, duplicate: the plan has structure.insert off"),
        (Edit(3, Move()), EDITABLE, "edit at step 3, move: the rollout has steps 0 to 2"),
        (Edit(-1, Move()), EDITABLE, "edit at step -1, move: the rollout has steps 0 to 2"),
    ],
)
def test_edit_refuses_invalid_operations(edit, spec, message):
    simulator, state, _ = encoded()
    with pytest.raises(InputError, match=message):
        future(simulator, state, 3, [edit], spec)


def test_files(tmp_path):
    simulator, state, _ = encoded()
    file = tmp_path / "edits.yaml"
    file.write_text(
        yaml.safe_dump(
            [
                {"step": 0, "op": "remove", "of": "frozen"},
                {"step": 2, "op": "move", "of": {"which": "all", "box": [[0, 0, 0], [1, 1, 1]]}, "by": [0, 0, 1]},
                {"step": 3, "op": "insert", "scene": "other/0000", "by": [0.5, 0, 0]},
                {"step": 4, "op": "recolor", "color": [1, 0, 0]},
                {"step": 5, "op": "rotate", "axis": [0, 0, 1], "degrees": 90, "about": None},
                {"step": 6, "op": "throw", "velocity": [0, 0, 0.1]},
                {"step": 7, "op": "duplicate", "by": [1, 0, 0]},
            ]
        )
    )
    asked = []
    edits = load_edits(file, lambda folder: asked.append(folder) or state)
    assert asked == [tmp_path / "other/0000"] and [edit.step for edit in edits] == [0, 2, 3, 4, 5, 6, 7]
    assert edits[0].operation == Remove("frozen") and edits[3].operation == Recolor(color=(1, 0, 0))
    assert edits[1].operation == Move(Selection("all", ((0, 0, 0), (1, 1, 1))), (0, 0, 1))
    assert edits[2].operation.particles is state and edits[5].operation == Throw(velocity=(0, 0, 0.1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("step: 0", "must hold a list; got dict"),
        ("- 3", "edit 0 must be a mapping; got 3"),
        ("- {op: move}", "edit 0: step must be a whole number of at least 0; got None"),
        ("- {step: 2, op: [move]}", "edit 0 at step 2: op must be one of remove, move"),
        ("- {step: 2, op: explode}", "edit 0 at step 2: op must be one of remove, move"),
        ("- {step: 2, op: move, to: [0, 0, 1]}", "edit 0 at step 2, move: to: unknown setting; known here: of, by"),
        ("- {step: 2, op: move, by: [0, 1]}", r"edit 0 at step 2, move: by: must be a list of 3; got \[0, 1\]"),
        ("- {step: 2, op: move, by: [0, 1, up]}", r"edit 0 at step 2, move: by\[2\]: must be a number; got 'up'"),
        ("- {step: 2, op: move, by: [0, 1, .nan]}", r"edit 0 at step 2, move: by\[2\]: must be a number; got nan"),
        ("- {step: 2, op: remove, of: ground}", "edit 0 at step 2, remove: of: which must be one of all, moving"),
        ("- {step: 2, op: move, of: {box: [[0, 0, 0], [1, -1, 1]]}}", "move: of: box must be the lowest and the high"),
        ("- {step: 2, op: rotate, axis: [0, 0, 0]}", "edit 0 at step 2, rotate: axis must be a nonzero vector"),
        ("- {step: 2, op: recolor, color: [2, 0, 0]}", "edit 0 at step 2, recolor: color must be three numbers in"),
        ("- {step: 2, op: insert}", "edit 0 at step 2, insert: scene must name a scene folder; got None"),
        ("- {step: 2, op: [", "cannot be read"),
    ],
)
def test_load_edits_refuses_malformed_files(tmp_path, text, message):
    (tmp_path / "edits.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        load_edits(tmp_path / "edits.yaml", lambda folder: None)


@pytest.mark.parametrize("model", CONFIGS)
def test_edit_of_model_with_all_priors(model):
    """Its particles have every field that there is."""
    more = {"priors": (InertiaConfig(radius=0.5), ShapeMatchingConfig(radius=0.5), OCCLUSION)}
    more |= {"background": "relightable"} if model == "latent" else {}
    config = CONFIGS[model]
    config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, **more))
    simulator, state, _ = encoded(config)
    edits = [Edit(step, Rotate("moving", degrees=30.0)) for step in (0, 1)] + [Edit(1, Recolor("moving", (1.0, 0, 0)))]
    step = future(simulator, state, 2, edits)[-1]
    own = {"sh", "quats"} if model == "explicit" else {"orientations", "color_transform", "initial_latents"}
    assert (
        own | {"irradiance_gain", "velocity", "rest_positions"} <= step.row_fields().keys()
        and step.means.isfinite().all()
    )


@pytest.mark.parametrize("step", [0, 1])
def test_removed_particles_occlude_no_light(step):
    """The conditioning features of the network, from the step of the edit on."""
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, priors=(OCCLUSION,)))
    simulator, state, _ = encoded(config)
    occluded = []
    simulator.dynamics.register_forward_pre_hook(
        lambda _, args: occluded.append(last_steps(args[0], 1).light_occlusion[:, 1])
    )
    future(simulator, state, 2, [Edit(step, Remove("moving"))])
    assert len(occluded) == 2 and [bool(now.any()) for now in occluded] == [step > 0, False]
