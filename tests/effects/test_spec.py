"""Specs: round trip through JSON and YAML, and hashes in checkpoints, exports and reports."""

import dataclasses
import itertools
import json

import pytest
import yaml

from gsim3d import presets
from gsim3d.effects.selection import Selection
from gsim3d.effects.spec import (
    AppearanceEffects,
    DynamicsEffects,
    EffectsSpec,
    OutputEffects,
    Sleep,
    StructureEffects,
    UnsupportedEffect,
)
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.settings import to_dict
from gsim3d.train.restore import build_simulator, restore
from tests.asserts import assert_same_bits

pytestmark = pytest.mark.usefixtures("one_thread")

GROUPS = {
    "dynamics": [
        DynamicsEffects(),
        DynamicsEffects("masked_out", 2),
        DynamicsEffects("asymmetric", 1),
        DynamicsEffects("dynamic", sleep=Sleep()),
        DynamicsEffects(sleep=Sleep("approx", 1e-4, 7)),
    ],
    "appearance": [
        AppearanceEffects(),
        AppearanceEffects(0, "none", False),
        AppearanceEffects(3, "dynamic", True),
        AppearanceEffects(frozen_appearance=("moving", Selection("all", ((0.0, 0.5, -1.0), (1.0, 2.0, 3.0))))),
    ],
    "structure": [StructureEffects(), StructureEffects(True, False), StructureEffects(True, True)],
    "outputs": [OutputEffects(), OutputEffects(False, True, True, True)],
}
SPECS = [EffectsSpec(**dict(zip(GROUPS, groups))) for groups in itertools.product(*GROUPS.values())]


def test_spec_round_trip():
    for spec in SPECS:
        plain = spec.to_dict()
        assert EffectsSpec.from_dict(json.loads(json.dumps(plain))) == spec
        assert EffectsSpec.from_dict(yaml.safe_load(yaml.safe_dump(plain))) == spec


@pytest.mark.parametrize("name", ["effects.yaml", "effects.json"])
def test_files(tmp_path, name):
    for spec in SPECS[::7]:
        spec.save(tmp_path / name)
        assert EffectsSpec.load(tmp_path / name) == spec
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_spec_hash_is_unique_and_order_independent():
    assert len({spec.hash for spec in SPECS}) == len(set(SPECS)) == len(SPECS) == 5 * 4 * 3 * 2
    for spec in SPECS:
        backwards = dict(reversed(spec.to_dict().items()))
        assert EffectsSpec.from_dict(backwards).hash == spec.hash


def test_spec_hash_of_integers_and_floats():
    specs = [
        EffectsSpec.from_dict(
            {"dynamics": {"sleep": {"eps": zero}}, "appearance": {"frozen_appearance": [{"box": box}]}}
        )
        for zero, box in ((0, [[0, 0, 0], [1, 1, 1]]), (0.0, [[0.0, -0.0, 0.0], [1.0, 1.0, 1.0]]))
    ]
    assert specs[0] == specs[1] and specs[0].hash == specs[1].hash != EffectsSpec().hash


def test_spec_hash_is_stable():
    assert EffectsSpec().hash == EffectsSpec.from_dict({"version": 1}).hash == "c3aa9744214caf6e"


def test_spec_of_scene_folder(tmp_path):
    scene = tmp_path / "set" / "ball" / "0000"
    scene.mkdir(parents=True)
    assert EffectsSpec.of_scene(scene) is None
    SPECS[1].save(tmp_path / "set" / "effects.yaml")
    assert EffectsSpec.of_scene(scene) == SPECS[1]
    SPECS[2].save(scene / "effects.yaml")
    assert EffectsSpec.of_scene(scene) == SPECS[2]


def saved(folder, spec, weights, model):
    data = {"history": 1, "image_size": [32, 32]}
    config = {"model": to_dict(model), "data": data, "effects": {"spec": spec.to_dict(), "hash": spec.hash}}
    return checkpoint.write(folder, checkpoint.Checkpoint(config=config, state={"step": 0}, model=weights))


def test_checkpoint_stores_spec_and_hash(tmp_path):
    spec, model = EffectsSpec(DynamicsEffects("masked_out", 1)), presets.tiny()
    folder = saved(tmp_path / "run", spec, build_simulator(model, 0).state_dict(), model)
    checkpoint.export(checkpoint.load(folder), tmp_path / "model.safetensors")
    for path in (folder, tmp_path / "model.safetensors"):
        restored = restore(path)
        assert restored.plan.spec == spec and restored.checkpoint.config["effects"]["hash"] == spec.hash


def test_restore_without_weights_of_off_effects(tmp_path):
    """A model of four steps whose last merging has no steps left to merge: its table is not read."""
    tiny = presets.tiny()
    dynamics = dataclasses.replace(tiny.dynamics, merge_windows=(2, 2))
    model = dataclasses.replace(tiny, dynamics=dynamics)
    whole = build_simulator(model, 0).eval()
    table = "dynamics.net.encoder.2.merge.time_embedding"
    plan = whole.plan()
    assert plan.unused == (table,)
    weights = {name: value for name, value in whole.state_dict().items() if name != table}
    restored = restore(saved(tmp_path / "run", EffectsSpec(), weights, model))
    assert restored.simulator.absent == {table}
    for name, value in weights.items():
        assert_same_bits(restored.simulator.state_dict()[name], value, name)
    restored.simulator.absent = frozenset({"dynamics.net.encoder.1.merge.time_embedding"})
    with pytest.raises(
        UnsupportedEffect, match="they require dynamics.net.encoder.1.merge.time_embedding, which the weights"
    ):
        restored.simulator.plan()
    needed = {name: value for name, value in weights.items() if "encoder.1.merge" not in name}
    with pytest.raises(InputError, match="the weights do not fit the model: .*encoder.1.merge.time_embedding"):
        restore(saved(tmp_path / "broken", EffectsSpec(), needed, model))
