"""Configurations of older checkpoints."""

import pytest

from gsim3d import presets
from gsim3d.compat.checkpoints import current_model
from gsim3d.compat.released_model import ReleasedModelConfig
from gsim3d.errors import InputError
from gsim3d.io.settings import from_dict, to_dict

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
    with pytest.raises(InputError, match=r"model.encoder.quirks.ray_depth: on, but others are off.*gsim3d import"):
        current_model(older(presets.tiny(), ray_depth=True))


def test_sections_that_are_no_mappings_are_left_for_the_reader():
    assert current_model({"encoder": None, "dynamics": {"quirks": 3}})["encoder"] is None
