"""What is off leaves the result of a build without it; what is on and does not matter changes nothing."""

import dataclasses

import pytest
import torch

from gsim3d.effects.spec import EffectsSpec
from gsim3d.simulator import Simulator
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.effects.models import MODELS, Case
from tests.test_simulator import CONFIG

pytestmark = pytest.mark.usefixtures("one_thread")


def assert_same_results(actual, expected):
    (steps, image), (other_steps, other_image) = actual, expected
    for step, other in zip(steps, other_steps, strict=True):
        for name, value in other.row_fields().items():
            assert_same_bits(getattr(step, name), value, name)
    for name, value in other_image._asdict().items():
        if value is not None:
            assert_same_bits(getattr(image, name), value, name)


IRRELEVANT = {
    "insertion and removal without an edit": {"structure": {"insert": True, "remove": True}},
    "sleep without rest": {"dynamics": {"sleep": {"eps": 0.0}}},
    "as many steps as the model has": {"dynamics": {"history": 4}},
    "the model's own degree": {"appearance": {"view_dependent": 1}},
    "other images": {"outputs": {"depth": True, "alpha": True, "features": True}},
}


@pytest.mark.parametrize("what", IRRELEVANT)
def test_irrelevant_effect_changes_no_bit(what):
    case = Case(steps=(2, 1))
    assert_same_results(case(EffectsSpec.from_dict(IRRELEVANT[what])), case(EffectsSpec()))


def test_sleep_without_rest_of_asymmetric_model():
    case = Case(MODELS["asymmetric"])
    asleep = {"dynamics": {"sleep": {"eps": 0.0, "policy": "approx"}}}
    assert_same_results(case(EffectsSpec.from_dict(asleep)), case(EffectsSpec()))


def test_zero_harmonics_change_nothing():
    case = Case()
    flat = case(EffectsSpec.from_dict({"appearance": {"view_dependent": 0}}))
    with torch.no_grad():
        for name in ("weight", "bias"):
            getattr(case.simulator.renderer.fc2, name)[:12].unflatten(0, (3, 4))[:, 1:] = 0
    image = case(EffectsSpec())[1]
    assert_close_relative_to_max(image.color, flat[1].color, 1e-6)


def test_history_of_one_matches_model_without_merging():
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, history_bits=0))
    case, other = Case(config, steps=(1,)), Case(config, steps=(1,))
    for stage in other.simulator.dynamics.net.encoder:
        stage.merge = None
    assert_same_results(case(EffectsSpec()), other(EffectsSpec()))


def test_degree_zero_matches_model_of_degree_zero():
    case = Case()
    config = dataclasses.replace(CONFIG, renderer=dataclasses.replace(CONFIG.renderer, sh_degree=0))
    weights = case.simulator.state_dict()
    for name in ("renderer.fc2.weight", "renderer.fc2.bias"):
        weights[name] = weights[name][[0, 4, 8, *range(12, 19)]]
    other = Case()
    other.simulator = Simulator(config).eval()
    other.simulator.load_state_dict(weights)
    assert_same_results(case(EffectsSpec.from_dict({"appearance": {"view_dependent": 0}})), other(EffectsSpec()))


@pytest.mark.parametrize("model", ["latent", "explicit"])
def test_changing_none_keeps_features(model):
    """Fewer columns are another product, which may round otherwise; what is held has the bits of the start."""
    case = Case(MODELS[model], n_steps=1)
    newest = case.state.select_clouds([1])
    (free,), _ = case(EffectsSpec())
    (held,), _ = case(EffectsSpec.from_dict({"appearance": {"changing": "none"}}))
    assert_same_bits(held.dynamic_latents, newest.dynamic_latents)
    assert_close_relative_to_max(held.means, free.means, 1e-6)
    assert not torch.equal(free.dynamic_latents, newest.dynamic_latents)
    if model == "explicit":
        (solid,), _ = case(EffectsSpec.from_dict({"appearance": {"opacity_changes": False}}))
        assert_same_bits(solid.opacities, newest.opacities)
        assert_same_bits(held.sh, newest.sh)
        assert not torch.equal(held.opacities, newest.opacities)


def test_masked_out_matches_removed_background():
    case, other = Case(), Case()
    other.state = other.state.select_rows(other.state.activity == 0)
    masked = {"dynamics": {"background": "masked_out"}}
    assert_same_results(case(EffectsSpec.from_dict(masked)), other(EffectsSpec()))
