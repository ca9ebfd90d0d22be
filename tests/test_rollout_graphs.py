"""Simulator.rollout(graph="auto"). On the CPU, which has no graphs, CapturedRollout runs the same steps eagerly."""

import copy
import dataclasses
import pickle

import pytest
import torch

from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep
from gsim3d.errors import CaptureError, InputError
from gsim3d.numerics import rollout_graphs
from gsim3d.state import DYNAMIC, FROZEN
from tests.test_cuda_graphs import CONFIG, SIZES, assert_same_steps, make_simulator, make_state

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def made(device, monkeypatch):
    """Graphs on any device; the list of those made."""
    graphs, make = [], CapturedRollout

    def noted(*arguments, **options):
        graphs.append(make(*arguments, **options))
        return graphs[-1]

    monkeypatch.setattr(rollout_graphs, "DEVICES", (device.type,))
    monkeypatch.setattr(rollout_graphs, "CapturedRollout", noted)
    return graphs


def check(simulator, state, n_steps=2, *, plan=None, replayed):
    with torch.no_grad():
        expected = simulator.rollout(state, n_steps, plan)
        steps = simulator.rollout(state, n_steps, plan, graph="auto")
    assert_same_steps(steps, expected)
    assert (simulator.graphs.obstacle is None) == replayed, simulator.graphs.obstacle


def test_repeated_calls_are_replayed(device, made):
    simulator = make_simulator(device)
    for seed, replayed in ((0, False), (1, True), (2, True)):
        check(simulator, make_state(seed, device), replayed=replayed)
    later = make_state(3, device)
    later = dataclasses.replace(later, cloud_step=later.cloud_step + 5)
    check(simulator, later, replayed=True)
    assert len(made) == 1


@pytest.mark.parametrize("background", ["symmetric", "asymmetric"])
def test_changed_weights_are_read_again(device, made, background):
    simulator = make_simulator(device, dynamics=dataclasses.replace(CONFIG.dynamics, background=background))
    state = make_state(device=device)
    for replayed in (False, True):
        check(simulator, state, replayed=replayed)
    with torch.no_grad():
        for parameter in simulator.dynamics.parameters():
            parameter.mul_(1.1)
    check(simulator, state, replayed=True)
    assert len(made) == 1
    simulator.load_state_dict(make_simulator(device, dynamics=simulator.config.dynamics).state_dict(), assign=True)
    check(simulator, state, replayed=False)


def test_another_kind_of_call_begins_anew(device, made):
    simulator, state = make_simulator(device), make_state(device=device)
    masked = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(background="masked_out")))
    fewer = make_state(device=device, sizes=SIZES[:1])
    moving = (state.activity == DYNAMIC).cumsum(0)
    calmer = dataclasses.replace(state, activity=torch.where(moving == 1, FROZEN, state.activity))
    calls = ((state, 2, None), (state, 3, None), (fewer, 3, None), (state, 3, masked), (calmer, 3, masked))
    for call in calls:
        check(simulator, call[0], call[1], plan=call[2], replayed=False)
    check(simulator, calmer, 3, plan=masked, replayed=True)
    assert len(made) == 1


def test_obstacles_are_named(device, made):
    simulator, state = make_simulator(device), make_state(device=device)

    def obstacle(**options):
        simulator.rollout(state, 2, graph="auto", **options)
        return simulator.graphs.obstacle

    assert obstacle() == "graphs have no gradients; call simulator.eval() and use torch.no_grad()"
    with torch.no_grad():
        assert obstacle(wrap=lambda f: f) == "a graph does not support wrap"
        assert obstacle(on_invalid="drop") == "a graph does not support on_invalid"
        asleep = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(sleep=Sleep())))
        assert obstacle(plan=asleep) == "a graph does not support dynamics.sleep of the plan"
        simulator.rollout(state, 0, graph="auto")
        assert simulator.graphs.obstacle == "there are no steps"
    assert made == []
    with pytest.raises(InputError, match="rollout: graph must be \"auto\" or None; got 'always'"):
        simulator.rollout(state, 1, graph="always")


def test_the_cpu_has_no_graphs():
    simulator, state = make_simulator(), make_state()
    for _ in range(2):
        check(simulator, state, replayed=False)
    assert simulator.graphs.obstacle == "graphs need a GPU; the state is on the CPU"


def test_what_cannot_be_captured_runs_step_by_step(device, made, monkeypatch):
    simulator, state, tries = make_simulator(device), make_state(device=device), []

    def refuse(*arguments, **options):
        tries.append(1)
        raise CaptureError("Captured: out of memory", out_of_memory=True)

    monkeypatch.setattr(rollout_graphs, "CapturedRollout", refuse)
    for _ in range(3):
        check(simulator, state, replayed=False)
    assert simulator.graphs.obstacle == "Captured: out of memory" and len(tries) == 1


def test_copies_begin_without_a_graph(device, made):
    simulator, state = make_simulator(device), make_state(device=device)
    for replayed in (False, True):
        check(simulator, state, replayed=replayed)
    for other in (copy.deepcopy(simulator), pickle.loads(pickle.dumps(simulator))):
        check(other, state, replayed=False)
    check(simulator, state, replayed=True)
