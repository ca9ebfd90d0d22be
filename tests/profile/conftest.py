"""A small simulator with random weights and two scenes."""

import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import InputSpec
from gsim3d.data import Scene
from gsim3d.effects.spec import EffectsSpec
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.profile.sweep import BenchmarkCase
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import Restored, build_simulator
from tests.tiny_scenes import write_scenes


@pytest.fixture(scope="session")
def case(tmp_path_factory):
    root = write_scenes(tmp_path_factory.mktemp("scenes"))
    simulator = build_simulator(presets.tiny(), seed=0).eval()
    with torch.no_grad():  # tiny's dynamics starts as the identity
        simulator.dynamics.net.head.fc2.weight.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    data = DataConfig(history=2, context_views=2, target_only_cameras=(3,), background_stride=2)
    simulator.inputs = InputSpec(history=2, context_views=2, background_stride=2, image_size=(32, 32))
    restored = Restored(simulator, data, simulator.plan(EffectsSpec()), Checkpoint({}, {}))
    return BenchmarkCase(restored, [Scene.open(root / "ball" / f"000{n}") for n in range(2)])
