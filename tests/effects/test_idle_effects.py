"""What is off, or on and idle, calls what a build without it calls; times are rows of tools/bench/effects.py."""

import dataclasses

import pytest

from tests.effects.models import MODELS, Case
from tests.test_simulator import CONFIG

pytestmark = pytest.mark.usefixtures("one_thread")

IDLE = {
    "insertion and removal": {"structure": {"insert": True, "remove": True}},
    "images in the same pass": {"outputs": {"depth": True, "alpha": True}},
}


@pytest.mark.parametrize("what", IDLE)
@pytest.mark.parametrize("model", MODELS)
def test_idle_effect_calls_no_operation(what, model):
    case = Case(MODELS[model])
    (idle, modules), (off, other_modules) = case.run(IDLE[what]), case.run({})
    assert idle.calls == off.calls and idle.bytes == off.bytes and modules == other_modules


def test_sleep_without_rest_costs_few_operations():
    case = Case(n_steps=6)
    (idle, modules), (off, other_modules) = case.run({"dynamics": {"sleep": {"eps": 0.0}}}), case.run({})
    assert modules == other_modules
    for operation in ("gsim3d.sparse_conv.default", "gsim3d.patch_attn.default", "gsim3d.build_pyramid.default"):
        assert idle.calls[operation] == off.calls[operation]
    more = idle.calls - off.calls
    assert more["aten.amax.default"] == 5 * 2, "positions and latents, not after the last step"
    assert more["aten.equal.default"] == 1, "a GPU is waited for"
    assert not more["aten.nonzero.default"] and not more["aten._local_scalar_dense.default"]
    assert more.total() / case.n_steps < 16, more


def test_history_of_one_calls_no_merge():
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, history_bits=0))
    case, other = Case(config, steps=(1,)), Case(config, steps=(1,))
    for stage in other.simulator.dynamics.net.encoder:
        stage.merge = None
    (off, _), (without, _) = case.run({}), other.run({})
    assert off.calls == without.calls and off.bytes == without.bytes
