"""A small scene, a model that was never trained, and what it predicts."""

import pytest

from gsim3d.cameras import InputSpec
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.train.restore import restore
from gsim3d.viewer.simulation import Simulation
from tests.test_simulator import SIZE, make_simulator
from tests.tiny_scenes import write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("data") / "ball" / "0000", size=SIZE)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    simulator = make_simulator()
    simulator.inputs = InputSpec(history=2, context_views=2, image_size=(SIZE, SIZE), fps=12.0)
    simulator.effects = EffectsSpec(dynamics=DynamicsEffects(history=2))
    return simulator.save_pretrained(tmp_path_factory.mktemp("model") / "model")


@pytest.fixture
def simulation(checkpoint, scene) -> Simulation:
    restored = restore(checkpoint)
    return Simulation(restored, restored.open_scene(scene), 3)


@pytest.fixture
def viser():
    return pytest.importorskip("viser", reason="needs viser")
