"""A history of one step merges nothing; harmonics of degree 0 see no directions; depth is a channel, not a second pass."""


import pytest
import torch

from gsim3d.dynamics import Dynamics
from gsim3d.effects import DynamicsEffects, EffectsSpec
from gsim3d.plans import make_plan, unused_parameters
from gsim3d.presets import paper_latent
from tests.asserts import assert_same_bits
from tests.dynamics.scenes import make_dynamics, make_history
from tests.effects.counting import counted

pytestmark = pytest.mark.usefixtures("one_thread")


def test_one_step_merges_nothing(monkeypatch):
    """No index of steps, no product with the table of marks, and the bits of the network that does merge."""
    dynamics, history = make_dynamics(), make_history((40,))
    with torch.no_grad(), counted() as alone:
        step = dynamics(history)
    assert all(stage.time_index is None for stage in dynamics.geometry(history).stages)
    monkeypatch.setattr(Dynamics, "_slots", lambda *_: ((3,), 2))
    with torch.no_grad(), counted() as merging:
        merged = dynamics(history)
    spared = merging.calls - alone.calls
    assert spared["aten.mm.default"] == 2, "one product with a table of marks for each stage that merges"
    for name, value in step.row_fields().items():
        assert_same_bits(value, getattr(merged, name), name)


def test_a_model_of_one_step_has_no_use_for_its_tables():
    one = paper_latent(1)
    names = [f"dynamics.net.encoder.{s}.merge.time_embedding" for s in range(1, 5)]
    assert unused_parameters(make_plan(EffectsSpec(), one), one, names) == tuple(names)
    four = paper_latent(4)
    less = make_plan(EffectsSpec(dynamics=DynamicsEffects(history=1)), four)
    assert unused_parameters(less, four, names) == tuple(names[2:]), "the mark of the newest step stays"
