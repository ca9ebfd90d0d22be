"""Configurations of older checkpoints."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from gsim3d import presets
from gsim3d.compat.checkpoints import current_model, current_weights
from gsim3d.compat.released_model import ReleasedModelConfig
from gsim3d.dynamics import Dynamics, DynamicsConfig
from gsim3d.errors import InputError
from gsim3d.io.files import read_yaml
from gsim3d.io.settings import from_dict, to_dict

ROOT = Path(__file__).parent.parent.parent

NAMES = ("ray_depth", "half_attention", "three_sigma_tiles")


def older(config, **on):
    model = to_dict(config)
    model.pop("release", None)
    for part in ("encoder", "dynamics", "renderer"):
        model[part] = {**model[part], "quirks": {name: on.get(name, on.get("all", False)) for name in NAMES}}
    model["stability"] = {"on_bad": "drop", "max_speed": 1.0, "max_latent": 2.0}
    return model


def read(model):
    content = current_model(model)
    return from_dict(ReleasedModelConfig if content.get("release") else presets.ModelConfig, content, "model")


@pytest.mark.parametrize("on", [False, True])
def test_switches_of_older_checkpoints(on):
    kind = ReleasedModelConfig if on else presets.ModelConfig
    before = older(kind(), all=on)
    config = read(before)
    assert type(config) is kind and config.stability.on_invalid == "drop"
    assert "quirks" in before["encoder"], "the section given is not changed"


def test_some_switches_are_refused():
    with pytest.raises(InputError, match=r"quirks.ray_depth: on, but other quirks are off.*gsim3d import"):
        current_model(older(presets.tiny(), ray_depth=True))


def test_sections_that_are_no_mappings_are_left_for_the_reader():
    assert current_model({"encoder": None, "dynamics": {"quirks": 3}})["encoder"] is None


def stored(model):
    return read_yaml(ROOT / f"gsim3d/pretrained/{model}/config.yaml")["model"], load_file(
        ROOT / f"gsim3d/pretrained/{model}/model.safetensors"
    )


@pytest.mark.parametrize("world", ["elastic", "rigid", "cloth"])
def test_switches_of_shipped_models_become_their_list_of_priors(world):
    section, _ = stored(f"{world}-small")
    listed = read_yaml(ROOT / f"configs/priors/{world}.yaml")
    base = presets.small().dynamics
    expected = from_dict(DynamicsConfig, listed, "dynamics", base).priors
    assert read(section).dynamics.priors == expected and "motion_length" in section["dynamics"]


@pytest.mark.parametrize("world", ["elastic", "rigid", "cloth"])
def test_products_of_shipped_models_keep_their_columns(world):
    section, weights = stored(f"{world}-small")
    config = read(section).dynamics
    found = current_weights(weights, config)
    assert "dynamics.net.stem.told.weight" in weights and "dynamics.net.stem.told.weight" not in found
    dynamics = Dynamics(config)
    dynamics.load_state_dict({k.removeprefix("dynamics."): v for k, v in found.items() if k.startswith("dynamics.")})
    stem = dynamics.net.stem.conv.full_weight()
    assert torch.equal(stem, weights["dynamics.net.stem.conv.weight"].float())
    conditioning = torch.cat([prior.in_proj.weight for prior in dynamics.priors if prior.in_proj], 1)
    assert torch.equal(conditioning, weights["dynamics.net.stem.told.weight"][:, : conditioning.shape[1]].float())
    gains = torch.cat([prior.gain_head.bias for prior in dynamics.priors if prior.gain_head])
    joined = torch.cat([dynamics.net.head.fc2.bias, gains])
    assert torch.equal(joined, weights["dynamics.net.head.fc2.bias"].float())
    assert current_weights(found, config).keys() == found.keys(), "weights of this version stay"


def test_weights_without_priors_stay():
    config = presets.paper_latent().dynamics
    weights = {"dynamics.net.stem.conv.weight": torch.zeros(1), "encoder.x": torch.ones(1)}
    assert current_weights(weights, config) == weights


@pytest.mark.parametrize(
    "switches", [{"motion_length": 0.3}, {"motion_length": 0.3, "velocity": True, "gravity": [0.0, 0.0, -0.01]}]
)
def test_switches_without_prior_are_refused(switches):
    section = to_dict(presets.tiny())
    del section["dynamics"]["priors"]
    section["dynamics"] |= switches
    with pytest.raises(InputError, match="not supported in this version"):
        current_model(section)
