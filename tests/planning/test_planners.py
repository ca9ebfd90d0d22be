"""Planners against the linear-quadratic regulator, and what all of them promise."""

import math

import pytest
import torch

from gsim3d.errors import InputError, NumericalError
from gsim3d.planning import CEM, MPPI, GradientDescent
from gsim3d.planning.planners import colored_noise, softmin

PLANNERS = {"mppi": MPPI, "cem": CEM, "gradient": GradientDescent}
HORIZON, DT, CONTROL_WEIGHT = 15, 0.2, 0.1
A = torch.tensor([[1.0, DT], [0.0, 1.0]], dtype=torch.float64)
B = torch.tensor([[DT**2 / 2], [DT]], dtype=torch.float64)
START = torch.tensor([1.0, 0.0], dtype=torch.float64)
LOW, HIGH = torch.tensor([-4.0], dtype=torch.float64), torch.tensor([4.0], dtype=torch.float64)


def double_integrator(state, actions):
    """States [K, H, 2] after each action: position and velocity. Without matrix products, whose last bits depend on the
    number of rows on some processors."""
    (position, velocity), states = state.expand(len(actions), 2).unbind(1), []
    for force in actions[..., 0].unbind(1):
        position, velocity = position + DT * velocity + DT**2 / 2 * force, velocity + DT * force
        states.append(torch.stack([position, velocity], 1))
    return torch.stack(states, 1)


def quadratic(states, actions):
    return states.square().sum((1, 2)) + CONTROL_WEIGHT * actions.square().sum((1, 2))


def lqr_cost():
    """Cost of the optimal sequence from START, by the Riccati recursion."""
    value = torch.zeros(2, 2, dtype=torch.float64)
    for _ in range(HORIZON):
        later = torch.eye(2, dtype=torch.float64) + value
        gain = torch.linalg.solve(CONTROL_WEIGHT + B.T @ later @ B, B.T @ later @ A)
        value = A.T @ later @ (A - B @ gain)
    return float(START @ value @ START)


def planner(kind, dynamics=double_integrator, cost=quadratic, **options):
    return PLANNERS[kind](dynamics, cost, LOW, HIGH, **{"horizon": HORIZON, **options})


@pytest.mark.parametrize("kind", PLANNERS)
def test_double_integrator_costs_at_most_five_percent_more_than_lqr(kind):
    settings = {"mppi": {"iterations": 30}, "cem": {"iterations": 15}, "gradient": {"iterations": 100}}
    plan = planner(kind, samples=256, color=0.5, **settings[kind]).plan(START)
    assert 0.999 * lqr_cost() <= plan.cost <= 1.05 * lqr_cost()
    assert plan.cost == pytest.approx(
        float(quadratic(double_integrator(START, plan.actions[None]), plan.actions[None]))
    )


@pytest.mark.parametrize("kind", ["mppi", "cem"])
def test_settings_of_the_reference_reach_five_percent(kind):
    agents = [planner(kind, color=0.5, samples=128, iterations=10, seed=seed) for seed in range(5)]
    assert max(agent.plan(START).cost for agent in agents) <= 1.05 * lqr_cost()


@pytest.mark.parametrize("kind", PLANNERS)
def test_closed_loop_with_warm_starts_reaches_the_origin(kind):
    agent, state = planner(kind, samples=64), START
    for _ in range(30):
        state = double_integrator(state, agent.plan(state).actions[None, :1])[0, -1]
    assert state.norm() < 0.1


@pytest.mark.parametrize("kind", PLANNERS)
def test_plans_do_not_depend_on_chunks_and_are_functions_of_the_seed(kind):
    plans = [planner(kind, chunk=chunk, seed=3).plan(START) for chunk in (None, 1, 7, 64)]
    assert all(torch.equal(plans[0].actions, other.actions) for other in plans[1:])
    assert not torch.equal(plans[0].actions, planner(kind, seed=4).plan(START).actions)
    agent = planner(kind, seed=3)
    first = agent.plan(START)
    agent.plan(START)
    agent.reset()
    assert torch.equal(agent.plan(START).actions, first.actions)


@pytest.mark.parametrize("kind", PLANNERS)
def test_dynamics_and_cost_may_edit_actions_in_place(kind):
    def dynamics(state, actions):
        states = double_integrator(state, actions)
        actions += 1
        return states

    def cost(states, actions):
        costs = quadratic(states, actions.clone())
        actions += 1
        return costs

    assert torch.equal(planner(kind, dynamics, cost).plan(START).actions, planner(kind).plan(START).actions)


def test_history_has_all_iterations_where_gradients_are_not_finite():
    norm = planner("gradient", lambda state, actions: actions, lambda s, _: s.square().sum((1, 2)).sqrt(), samples=1)
    assert norm.plan(START).history == (0.0,) * 30


@pytest.mark.parametrize("executed", [0, 1, 4])
def test_a_plan_begins_with_the_last_one_without_executed_actions(executed):
    agent = planner("mppi")
    last = agent.plan(START).actions
    agent.samples = agent.iterations = 1  # nothing but the sequence that it begins with
    begun = agent.plan(START, executed).actions
    assert torch.equal(begun[: HORIZON - executed], last[executed:])
    assert (begun[HORIZON - executed :] == last[-1]).all()


@pytest.mark.parametrize("kind", PLANNERS)
def test_lowest_cost_never_rises_and_actions_stay_inside_bounds(kind):
    # The cost pulls beyond the upper bound.
    plan = planner(kind, cost=lambda states, actions: -actions.sum((1, 2))).plan(START)
    assert len(plan.history) >= 1 and all(b <= a for a, b in zip(plan.history, plan.history[1:]))
    assert plan.history[-1] == plan.cost
    assert plan.actions.shape == (HORIZON, 1) and (plan.actions >= LOW).all() and (plan.actions <= HIGH).all()
    assert plan.actions.mean() > 0.8 * HIGH.item()


@pytest.mark.parametrize("kind", PLANNERS)
def test_sequences_without_a_finite_cost_are_never_chosen(kind):
    def cost(states, actions):
        return torch.where(actions[:, 0, 0] > 0, math.nan, quadratic(states, actions))

    assert planner(kind, cost=cost).plan(START).actions[0, 0] <= 0
    with pytest.raises(NumericalError, match="no sequence of actions has a finite cost"):
        planner(kind, cost=lambda states, actions: actions[:, 0, 0] * math.nan).plan(START)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"horizon": 0}, "horizon must be a whole number of at least 1"),
        ({"samples": 2.5}, "samples must be a whole number of at least 1; got 2.5"),
        ({"chunk": 0}, "chunk must be a whole number of at least 1"),
        ({"horizon": True}, "horizon must be a whole number of at least 1; got True"),
        ({"noise": -1.0}, "noise must be positive"),
        ({"noise": "a"}, "noise must be positive and color 0 or more; got 'a'"),
        ({"seed": None}, "seed must be a whole number from 0 to .*; got None"),
        ({"seed": 1.5}, "seed must be a whole number"),
        ({"seed": 2**70}, "seed must be a whole number from 0 to"),
        ({"temperature": 0.0}, "temperature must be positive"),
        ({"effective_share": 1.0}, "effective_share"),
    ],
)
def test_wrong_options_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        planner("mppi", **options)


def test_wrong_bounds_and_costs_are_refused():
    with pytest.raises(InputError, match="low below high"):
        MPPI(double_integrator, quadratic, HIGH, LOW)
    with pytest.raises(InputError, match="floating dtype"):
        MPPI(double_integrator, quadratic, [-1], [1])
    for wrong, got in ((lambda states, actions: states, r"\[64, 15, 2\]"), (lambda states, actions: 1.0, "float")):
        with pytest.raises(InputError, match=f"one value a sequence .*got {got}"):
            planner("mppi", cost=wrong).plan(START)
    with pytest.raises(InputError, match="executed must be a whole number"):
        planner("mppi").plan(START, 1.5)
    for constant in (torch.ones(1), torch.ones(1, requires_grad=True)):
        with pytest.raises(InputError, match="must be differentiable; use MPPI or CEM"):
            planner("gradient", cost=lambda states, actions, one=constant: one.sum().expand(len(actions))).plan(START)


def test_bounds_of_an_action_space_are_taken():
    bounds = LOW.numpy(), HIGH.numpy()
    assert torch.equal(
        MPPI(double_integrator, quadratic, *bounds, horizon=5).plan(START).actions,
        MPPI(double_integrator, quadratic, LOW, HIGH, horizon=5).plan(START).actions,
    )


@pytest.mark.parametrize("kind", ["mppi", "cem"])
def test_only_sequences_of_finite_cost_move_the_mean(kind):
    """Nothing but the sequence that plans begin with, zeros, has a cost; later not even that."""
    calls = []

    def cost(states, actions):
        calls.append(actions)
        alone = (actions == 0).flatten(1).all(1) & (len(calls) < 3)
        return torch.where(alone, 1.0, math.nan)

    plan = planner(kind, cost=cost, iterations=4).plan(START)
    assert plan.cost == 1 and not plan.actions.any() and plan.history == (1.0,) * 4
    assert all(not sequences[0].any() for sequences in calls)  # the mean


def test_gradients_of_weights_stay_as_they_are():
    weight = torch.ones((), dtype=torch.float64, requires_grad=True)
    planner("gradient", dynamics=lambda state, actions: weight * double_integrator(state, actions)).plan(START)
    assert weight.grad is None


def test_softmin_reaches_the_effective_sample_size():
    costs = torch.rand(100, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for effective in (2.0, 10.0, 50.0):
        weights = softmin(costs, None, effective)
        assert weights.sum().item() == pytest.approx(1) and 1 / weights.square().sum().item() == pytest.approx(
            effective
        )
        assert torch.equal(weights.argsort(descending=True), costs.argsort())
    assert torch.equal(softmin(torch.tensor([2.0, 2.0]).double(), None, 1.0), torch.tensor([0.5, 0.5]).double())
    assert softmin(torch.tensor([0.0, math.inf]).double(), 1.0, 1.0).tolist() == [1.0, 0.0]


@pytest.mark.parametrize("n", [1, 2, 9, 10])
@pytest.mark.parametrize("color", [0.0, 1.0, 2.0])
def test_colored_noise_has_unit_variance_and_more_slow_than_fast_waves(n, color):
    noise = colored_noise((20_000, n), color, torch.Generator().manual_seed(1))
    assert noise.square().mean().item() == pytest.approx(1, rel=0.05)
    if n > 2 and color:
        power = torch.fft.rfft(noise).abs().square().mean(0)
        assert (power[1:].diff() < 0).all()
