"""An effect that is off runs no kernel, makes no buffer and calls no module."""

import dataclasses

import pytest
import torch

import gsim3d.effects.edits
import gsim3d.simulator
from gsim3d.effects.spec import EffectsSpec
from tests.effects.models import MODELS, Case
from tests.test_simulator import CONFIG

pytestmark = pytest.mark.usefixtures("one_thread")

ALL_IMAGES = {"depth": True, "alpha": True, "features": True}
# effect -> model, its spec with the effect on and off, and how many calls of which operations that spares at least
EFFECTS = {
    "history": ("latent", {}, {"dynamics": {"history": 1}}, {"aten.mm.default": 2}),
    "background": ("latent", {}, {"dynamics": {"background": "masked_out"}}, {}),
    "background computed once": (
        "asymmetric", {}, {"dynamics": {"background": "masked_out"}}, {"gsim3d.sparse_conv.default": 5},
    ),
    "sleep": ("latent", {"dynamics": {"sleep": {}}}, {}, {}),
    "view_dependent": ("latent", {}, {"appearance": {"view_dependent": 0}}, {}),
    "changing": ("latent", {}, {"appearance": {"changing": "none"}}, {"aten.tanh.default": 2}),
    "frozen_appearance": (
        "latent", {"appearance": {"frozen_appearance": ["frozen"]}}, {}, {"aten.masked_fill.Scalar": 2},
    ),
    "opacity_changes": ("explicit", {}, {"appearance": {"opacity_changes": False}}, {"aten.clamp.default": 2}),
    "features": ("latent", {"outputs": {"features": True}}, {}, {"aten.cat.default": 1}),
    "rgb": ("latent", {"outputs": ALL_IMAGES}, {"outputs": {"rgb": False, **ALL_IMAGES}}, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", EFFECTS)
def test_off_effect_calls_and_allocates_less(name):
    model, on, off, spared = EFFECTS[name]
    case = Case(MODELS[model])
    plans = [case.simulator.plan(EffectsSpec.from_dict(values)) for values in (on, off)]
    assert name.split()[0] in plans[0].on and name.split()[0] not in plans[1].on
    (with_it, modules), (without, other_modules) = case.run(on), case.run(off)
    assert other_modules <= modules and without.bytes < with_it.bytes
    for operation, count in spared.items():
        assert with_it.calls[operation] - without.calls[operation] >= count, operation


def test_model_of_one_step_enters_no_merge():
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, history_bits=0))
    case = Case(config, steps=(1,))
    _, modules = case.run({})
    merges = {
        name for name, _ in case.simulator.named_modules() if name.startswith("dynamics") and name.endswith("merge")
    }
    assert len(merges) == 2 and not merges & modules and "dynamics.net.encoder.1.pool" in modules
    assert set(case.simulator.plan().unused) == {f"{name}.time_embedding" for name in merges}


def test_masked_out_particles_do_not_enter_network():
    case = Case()
    seen = []
    case.simulator.dynamics.net.register_forward_pre_hook(lambda _, args: seen.append(args[0].shape[0]))
    case(EffectsSpec())
    case(EffectsSpec.from_dict({"dynamics": {"background": "masked_out"}}))
    moving = int((case.state.activity == 0).sum())
    assert seen[0] == case.state.n_rows and seen[2] == moving < seen[0]


def test_rollout_without_sleep_keeps_no_log(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("called although it is off")

    for name in ("rollout_in_parts", "Sleepers"):
        monkeypatch.setattr(gsim3d.simulator, name, refuse)
    monkeypatch.setattr(gsim3d.effects.edits.Edit, "apply", refuse)
    case = Case()
    monkeypatch.setattr(case.simulator, "_colors", refuse)
    steps, image = case(EffectsSpec())
    assert len(steps) == 2 and image.alpha is None and image.depth is None and image.features is None
    assert steps[0].orientations is None and steps[0].color_transform is None and steps[0].frozen_appearance is None
    with pytest.raises(AssertionError, match="although it is off"):
        case(EffectsSpec.from_dict({"dynamics": {"sleep": {}}}))


def test_constant_features_are_not_predicted():
    case = Case()
    layout, head = case.simulator.dynamics.layout, case.simulator.dynamics.net.head
    held = layout.changes("none")
    assert layout.columns(held) == [(4, 7)] and layout.columns(layout.changes()) is None
    assert head(torch.rand(20, 8), layout.columns(held)).shape == (20, 3)
