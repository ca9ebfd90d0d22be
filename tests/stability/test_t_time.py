"""Hard cases of time: histories of any length, with empty steps, out of order."""

import dataclasses

import pytest
import torch

from tests.asserts import assert_same_bits
from tests.dynamics.scenes import TINY, make_dynamics, make_history
from tests.stability.steps import check_same_rows, check_step

EIGHT_STEPS = dataclasses.replace(TINY, history_bits=3, merge_windows=(2, 4))
SIZES = (14, 9, 12, 10, 8, 11, 13)


@pytest.mark.parametrize("n_steps", [3, 5, 6, 7])
def test_t30_lengths_that_are_no_power_of_two(setting, measured, n_steps):
    """Steps are counted back from the newest: a step that is absent is a step without particles."""
    history = make_history(SIZES[:n_steps])
    step = check_step(setting, measured, history, EIGHT_STEPS)
    missing = 8 - n_steps
    padded = dataclasses.replace(
        history,
        cu_rows=torch.cat([torch.zeros(missing, dtype=torch.int64), history.cu_rows]),
        cloud_scene=torch.zeros(8, dtype=torch.int64),
        cloud_step=torch.arange(8),
    )
    everything = (torch.ones(n, dtype=torch.bool) for n in (SIZES[n_steps - 1], history.n_rows))
    check_same_rows(setting, measured, check_step(setting, measured, padded, EIGHT_STEPS), step, *everything)


def test_t31_one_step_merges_nothing(setting, measured):
    """With one step, and nothing learned of time, the model is the one that knows no time."""

    def forget_time(dynamics):
        for name, parameter in dynamics.named_parameters():
            if "time_embedding" in name:
                parameter.data.zero_()

    history = make_history((30,))
    step = check_step(setting, measured, history, prepare=forget_time)
    timeless = check_step(setting, measured, history, dataclasses.replace(TINY, history_bits=0), prepare=forget_time)
    check_same_rows(setting, measured, step, timeless, *[torch.ones(30, dtype=torch.bool)] * 2)


@pytest.mark.parametrize("n_rows", [(12, 9, 0), (12, 0, 9), (0, 12, 9), (0, 0, 9), (12, 0, 0, 9), (12, 9, 0, 0)])
def test_t32_steps_without_points(setting, measured, n_rows):
    """An empty step is one that was never there; where the newest is empty, so is the next."""
    history = make_history(n_rows)
    step = check_step(setting, measured, history)
    assert step.fields["means"].shape == (n_rows[-1], 3)
    kept = [q for q, n in enumerate(n_rows) if n or q == len(n_rows) - 1]
    absent = check_step(setting, measured, history.select_clouds(kept))
    everything = (torch.ones(n, dtype=torch.bool) for n in (n_rows[-1], sum(n_rows)))
    check_same_rows(setting, measured, step, absent, *everything)


BROKEN = {
    "steps exchanged": ({"cloud_step": [1, 0, 0, 1]}, "sorted by .scene, step."),
    "a step twice": ({"cloud_step": [0, 0, 0, 1]}, "sorted by .scene, step."),
    "scenes exchanged": ({"cloud_scene": [1, 1, 0, 0]}, "sorted by .scene, step."),
    "scenes mixed": ({"cloud_scene": [0, 1, 0, 1], "cloud_step": [0, 0, 1, 1]}, "sorted by .scene, step."),
    "offsets descend": ({"cu_rows": [0, 9, 5, 14, 20]}, "cu_rows"),
    "offsets end early": ({"cu_rows": [0, 5, 9, 14, 19]}, "cu_rows"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_t33_unsorted_clouds(setting, measured, what):
    changes, message = BROKEN[what]
    history = make_history((5, 4, 5, 6))
    history = dataclasses.replace(
        history,
        cloud_scene=torch.tensor([0, 0, 1, 1]),
        cloud_step=torch.tensor([0, 1, 0, 1]),
        origin=torch.zeros(2, 3).double(),
    )
    dynamics = setting.to(make_dynamics())
    assert torch.isfinite(dynamics(setting.to(history)).means).all()
    broken = dataclasses.replace(history, **{name: torch.tensor(values) for name, values in changes.items()})
    with pytest.raises(ValueError, match=message):
        dynamics(setting.to(broken))
    measured.outcome("refused")


def test_t33_only_the_order_of_steps_counts(setting, measured):
    """Steps need not count from 0, nor without gaps inside the model's window."""
    history = make_history((12, 9))
    dynamics = setting.to(make_dynamics())
    later = dataclasses.replace(history, cloud_step=history.cloud_step + 1000)
    assert_same_bits(dynamics(setting.to(later)).means, dynamics(setting.to(history)).means)
    measured.outcome("bit-equal")
