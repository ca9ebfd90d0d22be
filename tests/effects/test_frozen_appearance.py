"""Bodies that a spec names keep their features wherever they go; all others have those of a rollout without names."""

import dataclasses
import json

import pytest
import torch

from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.effects.edits import Duplicate, Edit, Insert, Move, Remove
from gsim3d.effects.selection import Selection
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.state import FROZEN, concatenate, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.effects.models import MODELS, Case

pytestmark = pytest.mark.usefixtures("one_thread")

FAR = 9.0
EDITABLE = {"structure": {"insert": True, "remove": True}}


def half(state, which="all"):
    """Of a scene what is left of its middle."""
    middle = last_steps(state, 1).means[:, 0].median().item()
    return Selection(which, ((-FAR, -FAR, -FAR), (middle, FAR, FAR)))


def holding(*selections, **appearance):
    plain = [{"which": s.which, "box": s.box} for s in selections]
    return {"appearance": {"frozen_appearance": plain, **appearance}}


def rolled(case, values, n_steps=2, **options):
    simulator = case.simulator
    with torch.no_grad():
        return simulator.rollout(
            options.pop("state", case.state), n_steps, simulator.plan(EffectsSpec.from_dict(values)), **options
        )


@pytest.mark.parametrize("model", ["latent", "explicit"])
def test_frozen_appearance_keeps_features_and_moves(model):
    """In the first step nothing else differs by a bit; in later ones the others see a body that looks as it did."""
    case = Case(MODELS[model])
    body, start = half(case.state), last_steps(case.state, 1)
    named, free = rolled(case, holding(body)), rolled(case, {})
    rows = body.mask(start)
    assert 0 < int(rows.sum()) < start.n_rows
    for step in named:
        for name in ("dynamic_latents",) if model == "latent" else ("dynamic_latents", "sh"):
            assert_same_bits(getattr(step, name)[rows], getattr(start, name)[rows], name)
            assert not torch.equal(getattr(step, name)[~rows], getattr(start, name)[~rows])
    assert_same_bits(named[0].means, free[0].means)
    assert_same_bits(named[0].dynamic_latents[~rows], free[0].dynamic_latents[~rows])
    assert not torch.equal(named[0].means[rows], start.means[rows])
    assert not torch.equal(named[1].means, free[1].means)


def test_frozen_appearance_of_several_selections():
    case = Case()
    start = last_steps(case.state, 1)
    moving = half(case.state, "moving")
    step = rolled(case, holding(moving, Selection("frozen")))[-1]
    rows = moving.mask(start) | (start.activity == 1)
    assert_same_bits(step.dynamic_latents[rows], start.dynamic_latents[rows])
    assert not torch.equal(step.dynamic_latents[~rows], start.dynamic_latents[~rows])


def test_frozen_appearance_is_resolved_at_rollout_start():
    """A body that left its box is held still: along a rollout, in steps one by one, and in the next rollout."""
    case = Case(n_steps=4)
    values = holding(half(case.state, "moving"))
    away, plan = [Edit(1, Move("moving", (FAR, 0.0, 0.0)))], case.simulator.plan(EffectsSpec.from_dict(values))
    steps = rolled(case, values, 4, edits=away)
    rows, start = half(case.state, "moving").mask(last_steps(case.state, 1)), last_steps(case.state, 1)
    assert_same_bits(steps[-1].dynamic_latents[rows], start.dynamic_latents[rows])
    later = rolled(case, values, state=concatenate([case.state, *steps]))[-1]
    assert_same_bits(later.dynamic_latents[rows], start.dynamic_latents[rows])
    free = rolled(case, {}, state=concatenate([case.state, *steps]))[-1]
    assert free.frozen_appearance is None and not torch.equal(free.dynamic_latents[rows], start.dynamic_latents[rows])
    state, one_by_one = case.state, rolled(case, values, 3)
    for expected in one_by_one:
        with torch.no_grad():
            state = case.simulator.step(state, plan)
        assert_same_bits(last_steps(state, 1).dynamic_latents, expected.dynamic_latents)


def test_frozen_appearance_follows_edits():
    case = Case()
    values, start = EDITABLE | holding(Selection("moving")), last_steps(case.state, 1)
    edits = [Edit(0, Duplicate("moving", (0.4, 0.0, 0.0))), Edit(1, Remove("frozen"))]
    edits.append(Edit(1, Insert("all", rolled(case, values)[-1])))
    first, second = rolled(case, values, edits=edits)
    moving = start.dynamic_latents[start.activity == 0]
    assert_same_bits(first.dynamic_latents[first.frozen_appearance], torch.cat([moving, moving]))
    assert_same_bits(second.dynamic_latents[second.frozen_appearance], torch.cat([moving, moving]))
    assert second.n_rows == 2 * len(moving) + start.n_rows, "the appearance of inserted particles is not frozen"


@pytest.mark.parametrize("background", ["frozen", "masked_out", "dynamic"])
@pytest.mark.parametrize("model", ["latent", "asymmetric"])
def test_frozen_appearance_with_every_background(model, background):
    case = Case(MODELS[model])
    body, start = half(case.state), last_steps(case.state, 1)
    step = rolled(case, {"dynamics": {"background": background}} | holding(body))[-1]
    kept = start.activity == 0 if background == "masked_out" else torch.ones_like(start.activity, dtype=torch.bool)
    rows = body.mask(start)[kept]
    assert_same_bits(step.dynamic_latents[rows], start.dynamic_latents[kept][rows])
    assert not torch.equal(step.dynamic_latents[~rows], start.dynamic_latents[kept][~rows])


@pytest.mark.parametrize("model", ["latent", "asymmetric"])
def test_frozen_appearance_of_captured_rollout(model, device):
    """Of a state from a rollout, the particles that were selected before, though all have moved away."""
    case = Case(MODELS[model], steps=(1,))
    dtype = torch.float32 if device.type == "cpu" else torch.float64  # see tests/test_cuda_graphs.py
    simulator = case.simulator.to(device, dtype)
    state = case.state.map(lambda t: t.to(dtype) if t.is_floating_point() and t is not case.state.origin else t)
    state = state.to(device)
    plan = simulator.plan(EffectsSpec.from_dict(holding(half(case.state))))
    captured = CapturedRollout(simulator, state, 2, plan, factor=2)
    moved = dataclasses.replace(state, means=state.means + 0.05)
    later = captured(state).steps[-1]
    again = dataclasses.replace(later, means=later.means + FAR * (later.activity == 0)[:, None])
    for given in (state, moved, again):
        with torch.no_grad():
            expected = simulator.rollout(given, 2, plan)
        actual = captured(given).steps
        for step, other in zip(actual, expected, strict=True):
            assert (
                torch.equal(step.frozen_appearance, other.frozen_appearance)
                and 0 < int(step.frozen_appearance.sum()) < step.n_rows
            )
            start = last_steps(given, 1)
            assert torch.equal(
                step.dynamic_latents[step.frozen_appearance], start.dynamic_latents[step.frozen_appearance]
            )
            for name, value in other.row_fields().items():
                assert_close_relative_to_max(getattr(step, name), value, 1e-11 if device.type == "cuda" else 0, name)
    assert not torch.equal(captured(state).steps[0].frozen_appearance, captured(moved).steps[0].frozen_appearance)


def test_frozen_appearance_is_off_without_changing_features():
    case = Case()
    plan = case.simulator.plan(EffectsSpec.from_dict(holding(half(case.state), changing="none")))
    assert "frozen_appearance" not in plan.on
    assert rolled(case, holding(half(case.state), changing="none"))[-1].frozen_appearance is None
    plan = case.simulator.plan(EffectsSpec.from_dict(holding(half(case.state))))
    assert dict(plan.switches)["frozen_appearance"] == "selections: 1"


def test_frozen_appearance_gradients():
    case = Case(n_steps=1)
    plan = case.simulator.plan(EffectsSpec.from_dict(holding(Selection("all"))))
    latents = case.state.dynamic_latents.requires_grad_()
    (step,) = case.simulator.rollout(dataclasses.replace(case.state, dynamic_latents=latents), 1, plan)
    (gradient,) = torch.autograd.grad(step.dynamic_latents.sum(), latents)
    newest = case.state.row_cloud() == 1
    assert_same_bits(gradient, newest[:, None].float().expand_as(gradient))


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ("moving", "effects: appearance.frozen_appearance: must be a list; got 'moving'"),
        ([3], r"effects: appearance.frozen_appearance\[0\]: must be a mapping of settings; got 3"),
        (
            ["ground"],
            r"effects: appearance.frozen_appearance\[0\]: which must be one of all, moving, frozen; got 'ground'",
        ),
        (
            [{"where": "here"}],
            r"effects: appearance.frozen_appearance\[0\].where: unknown setting; known here: which, box",
        ),
        (
            [{"box": [[0, 0, 0], [1, 1]]}],
            r"effects: appearance.frozen_appearance\[0\].box\[1\]: must be a list of 3; got \[1, 1\]",
        ),
        (
            [{"box": [[0, 0, 1], [1, 1, 0]]}],
            r"effects: appearance.frozen_appearance\[0\]: box must be the lowest and the highest corner",
        ),
    ],
)
def test_frozen_appearance_refuses_malformed_selections(held, message):
    with pytest.raises(InputError, match=message):
        EffectsSpec.from_dict({"appearance": {"frozen_appearance": held}})


def test_frozen_appearance_refuses_empty_selection():
    case = Case()
    nowhere = Selection("moving", ((8.0, 8.0, 8.0), (9.0, 9.0, 9.0)))
    message = (
        r"effects: appearance.frozen_appearance\[1\]: the selection is empty: no particle is moving in the box \[\[8.0"
    )
    with pytest.raises(InputError, match=message) as error:
        rolled(case, holding(half(case.state), nowhere))
    start = last_steps(case.state, 1)
    places = start.means[start.activity == 0]
    corners = str(error.value).split("; their bounds are ")[1]
    assert_close_relative_to_max(torch.tensor(json.loads(corners)), torch.stack([places.amin(0), places.amax(0)]), 0.01)


@pytest.mark.parametrize("model", ["latent", "explicit"])
def test_changing_frozen_keeps_appearance_of_bodies(model):
    """``changing: frozen``: features of what may move stay, bit by bit; the background's are those of ``all``."""
    case = Case(MODELS[model])
    start, (first, *_), (free, *_) = (
        last_steps(case.state, 1),
        *(rolled(case, {"appearance": {"changing": which}}) for which in ("frozen", "all")),
    )
    frozen = start.activity == FROZEN
    assert 0 < int(frozen.sum()) < start.n_rows
    for name in ("dynamic_latents",) if model == "latent" else ("dynamic_latents", "sh"):
        assert_same_bits(getattr(first, name)[~frozen], getattr(start, name)[~frozen], name)
        assert_same_bits(getattr(first, name)[frozen], getattr(free, name)[frozen], name)
        assert not torch.equal(getattr(first, name)[frozen], getattr(start, name)[frozen])
    assert_same_bits(first.means, free.means)
