"""Scenes of one batch with different specs have the futures and images that they have alone."""

import pytest
import torch

from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec, OutputEffects, Sleep
from gsim3d.errors import InputError
from tests.asserts import assert_same_bits
from tests.test_simulator import awake, make_frames, make_simulator, target_cameras

pytestmark = pytest.mark.usefixtures("one_thread")

SPECS = [
    EffectsSpec(DynamicsEffects("masked_out", history=2), outputs=OutputEffects(depth=True)),
    EffectsSpec(appearance=AppearanceEffects(0, "none"), outputs=OutputEffects(depth=True)),
    EffectsSpec(DynamicsEffects("masked_out", history=2), outputs=OutputEffects(depth=True)),
    EffectsSpec(
        DynamicsEffects("dynamic", history=1, sleep=Sleep()),
        AppearanceEffects(frozen_appearance=("frozen",)),
        outputs=OutputEffects(depth=True),
    ),
]


@torch.no_grad()
def test_plans_of_one_batch_match_separate_runs():
    simulator, frames = awake(make_simulator()), make_frames((2, 3, 1, 2))
    state, plans = simulator.encode(frames), [simulator.plan(spec) for spec in SPECS]
    steps = simulator.rollout(state, 3, plans=plans)
    cameras = target_cameras(frames, 4)
    twice = torch.tensor([3, 0, 2, 1, 0])
    cameras = cameras.select(torch.zeros(5, dtype=torch.int64), twice)
    behind = torch.rand(5, 3)
    images = simulator.render(steps[-1], cameras, behind, plans=plans)
    assert images.alpha is None and images.depth.shape == (5, 16, 16)
    for scene, plan in enumerate(plans):
        alone = state.select_clouds([q for q, s in enumerate(state.clouds.scenes) if s == scene])
        expected = simulator.rollout(alone, 3, plan)
        for step, one in zip(steps, expected, strict=True):
            mine = step.select_clouds([step.clouds.scenes.index(scene)])
            assert mine.clouds.steps == one.clouds.steps
            for name, value in one.row_fields().items():
                assert_same_bits(getattr(mine, name), value, f"scene {scene}: {name}")
        rows = torch.nonzero(twice == scene)[:, 0]
        seen = cameras.select(rows, torch.zeros_like(rows))
        image = simulator.render(expected[-1], seen, behind[rows], plan)
        assert_same_bits(images.color[rows], image.color, f"scene {scene}: colour")
        assert_same_bits(images.depth[rows], image.depth, f"scene {scene}: depth")


def test_plans_of_one_batch_refuse_mismatches():
    simulator, frames = make_simulator(), make_frames((1, 1))
    state = simulator.encode(frames)
    plans = [simulator.plan(EffectsSpec(outputs=OutputEffects(depth=on))) for on in (True, False)]
    with pytest.raises(InputError, match="plans: there must be one for each of 2 scenes; got 1"):
        simulator.rollout(state, 1, plans=plans[:1])
    with pytest.raises(InputError, match="plans: must have equal outputs"):
        simulator.render(state, target_cameras(frames, 2), plans=plans)
