"""Background unfreezing: training marks random cubes of the background as movable."""

import dataclasses

import numpy as np
import pytest
import torch

from gsim3d.data import Scene, find_scenes
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec, Sleep
from gsim3d.errors import InputError
from gsim3d.state import DYNAMIC, FROZEN
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.samples import unfreeze
from tests.asserts import assert_same_bits
from tests.effects.resting import make_scenes
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

CONFIG = TrainConfig(
    phases=(PhaseConfig(steps=3, horizon=2, target_views=2, learning_rate=1e-3),),
    model={"dynamics": {"background": "asymmetric", "zero_init": False}},
    data=DataConfig(history=2, context_views=2, background_stride=2, unfrozen_background=1.0),
    log_every=1,
)
SPEC = EffectsSpec(dynamics=DynamicsEffects(sleep=Sleep(halo=0.2)))


def unfrozen_particles(state, after):
    return (state.activity == FROZEN) & (after.activity == DYNAMIC)


def test_unfreeze_takes_whole_cubes_at_every_step():
    state = make_scenes()
    after = unfreeze(state, 1.0, SPEC, np.random.default_rng(3))
    rows, frozen = unfrozen_particles(state, after), state.activity == FROZEN
    assert torch.equal(after.activity[~rows], state.activity[~rows])
    assert rows.any() and (frozen & ~rows).any()
    scene = state.cloud_scene[state.row_cloud()]
    cubes = {}
    for index, is_unfrozen in zip(
        torch.cat([scene[frozen, None], torch.floor(state.means[frozen].double() / 0.2).long()], 1).tolist(),
        rows[frozen].tolist(),
        strict=True,
    ):
        cubes.setdefault(tuple(index), set()).add(is_unfrozen)
    assert all(len(found) == 1 for found in cubes.values()) and len(cubes) > 20


def test_unfreeze_draws_its_share_up_to_the_given_one():
    state, shares = make_scenes(), []
    for seed in range(100):
        after = unfreeze(state, 0.5, SPEC, np.random.default_rng(seed))
        shares.append((unfrozen_particles(state, after).sum() / (state.activity == FROZEN).sum()).item())
    assert abs(np.mean(shares) - 0.25) < 0.05 and max(shares) < 0.8
    assert_same_bits(
        unfreeze(state, 0.5, SPEC, np.random.default_rng(1)).activity,
        unfreeze(state, 0.5, SPEC, np.random.default_rng(1)).activity,
    )


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return [Scene.open(path) for path in find_scenes(write_scenes(tmp_path_factory.mktemp("scenes"), 2))]


def test_an_asymmetric_model_trains_and_repeats_bit_by_bit(scenes, tmp_path):
    weights = []
    for run in ("a", "b"):
        trainer = Trainer(CONFIG, scenes, tmp_path / run)
        before = {name: value.clone() for name, value in trainer.simulator.dynamics.state_dict().items()}
        trainer.run(progress=False)
        assert trainer.n_skipped == 0
        weights.append(trainer.simulator.dynamics.state_dict())
    changed = [name for name, value in weights[0].items() if not torch.equal(value, before[name])]
    assert {name.split(".")[1] for name in changed} == {"stem", "encoder", "decoder", "head"}
    for name, value in weights[0].items():
        assert_same_bits(weights[1][name], value, name)


def test_recomputed_steps_change_no_bit(scenes, tmp_path):
    losses = []
    for recompute in ((), ("steps",)):
        trainer = Trainer(dataclasses.replace(CONFIG, recompute=recompute), scenes, tmp_path / str(len(recompute)))
        losses.append(trainer._gradients([0]))
    assert_same_bits(losses[0][0], losses[1][0])
    for one, other in zip(losses[0][2], losses[1][2], strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert_same_bits(one, other)


def test_unfreezing_needs_an_asymmetric_model(scenes, tmp_path):
    with pytest.raises(InputError, match="data.unfrozen_background"):
        Trainer(dataclasses.replace(CONFIG, model={}), scenes, tmp_path)
    with pytest.raises(InputError, match="unfrozen_background must be at most 1"):
        DataConfig(unfrozen_background=1.5)
