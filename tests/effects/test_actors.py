"""Actors: particles with prescribed displacements in rollouts."""

import dataclasses

import pytest
import torch

from gsim3d.effects.actors import Actor, Actors
from gsim3d.effects.edits import Edit, Move
from gsim3d.effects.selection import Selection
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep
from gsim3d.errors import InputError
from gsim3d.priors import InertiaConfig
from gsim3d.state import DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_same_bits
from tests.effects.models import MODELS
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS = 4
INERTIA = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, priors=(InertiaConfig(),)))
CONFIGS = {"latent": MODELS["latent"], "explicit": MODELS["explicit"], "inertia": INERTIA}


def encoded(config=CONFIG, steps=(2,)):
    simulator, frames = awake(make_simulator(config)), make_frames(steps)
    with torch.no_grad():
        return simulator, simulator.encode(frames)


def halves(state, axis=0):
    """Selections of the moving particles on both sides of their middle."""
    positions = state.means[state.activity == DYNAMIC]
    low, high = positions.amin(0) - 0.1, positions.amax(0) + 0.1
    middle = positions[:, axis].median().item()
    below, above = high.clone(), low.clone()
    below[axis], above[axis] = middle, middle + 1e-6
    boxes = (low.tolist(), below.tolist()), (above.tolist(), high.tolist())
    return [Selection("moving", tuple(map(tuple, box))) for box in boxes]


def displacements(seed=0, n_steps=STEPS, scale=0.02, scenes=()):
    return scale * torch.randn(*scenes, n_steps, 3, generator=torch.Generator().manual_seed(seed))


def rollout(simulator, state, n_steps=STEPS, actors=(), **options):
    with torch.no_grad():
        return simulator.rollout(state, n_steps, actors=actors, **options)


@pytest.mark.parametrize("config", CONFIGS)
def test_actors_move_exactly_as_prescribed_and_others_are_predicted(config):
    simulator, state = encoded(CONFIGS[config], (2, 2))
    moves = displacements(scenes=(2,))
    steps = rollout(simulator, state, actors=[Actor(moves, halves(state)[0])])
    before = last_steps(state, 1)
    acting = steps[0].actor == 0
    assert acting.any() and not acting.all()
    scene = steps[0].cloud_scene[steps[0].row_cloud()]
    for t, step in enumerate(steps):
        moved = moves[scene, t]
        assert_same_bits(step.means[acting], (before.means + moved)[acting])
        if step.velocity is not None:
            assert_same_bits(step.velocity[acting], moved[acting])
        before = step
    free = rollout(simulator, state)
    assert not torch.equal(free[1].means[~acting], steps[1].means[~acting])  # the network sees actors
    assert not torch.equal(steps[-1].dynamic_latents[acting], last_steps(state, 1).dynamic_latents[acting])


def test_input_of_a_step_holds_the_coming_displacement():
    simulator, state = encoded(steps=(2,))
    moves, seen = displacements(), []

    def record(predict):
        def step(history, *others):
            seen.append(history)
            return predict(history, *others)

        return step

    of = halves(state)[0]
    steps = rollout(simulator, state, actors=[Actor(moves, of)], wrap=record)
    simulated = [state.select_clouds([0]), state.select_clouds([1]), *steps]
    for t, history in enumerate(seen):
        *_, old, new = (history.select_clouds([q]) for q in range(history.n_clouds))
        moved = new.means[new.actor == 0].mean(0) - old.means[old.actor == 0].mean(0)
        assert torch.allclose(moved, moves[t], atol=1e-6)
        assert_same_bits(new.means, simulated[t + 1].means)  # positions of now are not changed
        others = old.actor < 0
        assert_same_bits(old.means[others], simulated[t].means[others])


def test_later_displacements_change_no_earlier_state():
    simulator, state = encoded()
    moves, of = displacements(), halves(state)[0]
    changed = moves.clone()
    changed[2:] += 0.05
    first, second = (rollout(simulator, state, actors=[Actor(d, of)]) for d in (moves, changed))
    for t in range(2):
        assert_same_bits(first[t].means, second[t].means)
        assert_same_bits(first[t].dynamic_latents, second[t].dynamic_latents)
    assert not torch.equal(first[2].means, second[2].means)


def test_order_of_actors_does_not_count():
    simulator, state = encoded()
    one, other = (Actor(displacements(seed), of) for seed, of in enumerate(halves(state)))
    for a, b in zip(rollout(simulator, state, actors=[one, other]), rollout(simulator, state, actors=[other, one])):
        assert_same_bits(a.means, b.means)
        assert_same_bits(a.dynamic_latents, b.dynamic_latents)


def test_gradients_flow_to_displacements():
    simulator, state = encoded()
    moves = displacements().requires_grad_()
    steps = simulator.rollout(state, STEPS, actors=[Actor(moves, halves(state)[0])])
    free = steps[-1].actor < 0
    (gradient,) = torch.autograd.grad(steps[-1].means[free].sum(), moves)
    assert gradient.isfinite().all() and (gradient[:-1].abs().amax(1) > 0).all()


def test_actors_go_on_after_an_edit():
    simulator, state = encoded()
    moves, of = displacements(), halves(state)[0]
    lifted = rollout(simulator, state, actors=[Actor(moves, of)], edits=[Edit(2, Move("moving", (0.0, 0.0, 0.1)))])
    plain = rollout(simulator, state, actors=[Actor(moves, of)])
    acting = plain[0].actor == 0
    change = (lifted[-1].means - plain[-1].means)[acting]
    assert torch.allclose(change, torch.tensor([0.0, 0.0, 0.1]).expand_as(change), atol=1e-6)


def test_unmarked_rollouts_are_unchanged():
    simulator, state = encoded()
    assert all(step.actor is None for step in rollout(simulator, state))
    marked = Actors([Actor(displacements(), halves(state)[0])], state, STEPS).state
    assert set(marked.actor.unique().tolist()) == {-1, 0}


@pytest.mark.parametrize(
    "moves, of, words",
    [
        (torch.zeros(STEPS, 2), "moving", r"displacements must be \[T, 3\]"),
        (torch.zeros(STEPS - 1, 3), "moving", "has 3 steps; the rollout has 4"),
        (torch.full((STEPS, 3), torch.nan), "moving", "must be finite"),
        (torch.zeros(3, STEPS, 3), "moving", r"or \[1, T, 3\]"),
        (torch.zeros(STEPS, 3), Selection("moving", ((9.0, 9.0, 9.0), (9.1, 9.1, 9.1))), "selection is empty"),
        (torch.zeros(STEPS, 3), "frozen", "frozen particles cannot be moved"),
    ],
)
def test_wrong_actors_are_refused_by_number(moves, of, words):
    simulator, state = encoded()
    fine = Actor(torch.zeros(STEPS, 3), halves(state)[0])
    activity = state.activity.clone()
    activity[state.means[:, 0] > state.means[:, 0].median()] = FROZEN
    state = dataclasses.replace(state, activity=activity)
    with pytest.raises(InputError, match=rf"actors\[1\].*{words}"):
        rollout(simulator, state, actors=[fine, Actor(moves, of)])


def test_overlapping_actors_and_plans_that_do_not_fit_are_refused():
    simulator, state = encoded()
    actor = Actor(torch.zeros(STEPS, 3), "moving")
    with pytest.raises(InputError, match=r"actors\[1\]: some of its particles belong to another actor"):
        rollout(simulator, state, actors=[actor, actor])
    plan = simulator.plan(EffectsSpec(DynamicsEffects(sleep=Sleep())))
    with pytest.raises(InputError, match="actors: .*sleep"):
        rollout(simulator, state, plan=plan, actors=[actor])
    with pytest.raises(InputError, match="give one plan"):
        rollout(simulator, state, plans=[simulator.plan()], actors=[actor])
