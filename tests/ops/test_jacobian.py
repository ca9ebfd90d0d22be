"""Which Jacobian a model draws with: exact, or clamped where it was trained so."""

import dataclasses

import pytest
import torch
import yaml

from gsim3d import presets
from gsim3d.compat.checkpoints import current_model
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.nn.gaussian_head import RendererConfig, render
from gsim3d.presets import ModelConfig
from gsim3d.pretrained import located
from gsim3d.train.restore import keep_jacobian
from tests.test_simulator import CONFIG, make_frames, make_simulator, target_cameras


def read(model):
    return from_dict(ModelConfig, current_model(model), "model").renderer.jacobian


@pytest.mark.parametrize("preset", ["tiny", "small", "paper_latent", "paper_explicit"])
def test_new_models_are_exact_and_say_so(preset):
    config = getattr(presets, preset)()
    assert config.renderer.jacobian == to_dict(config)["renderer"]["jacobian"] == read(to_dict(config)) == "exact"


def test_saved_models_that_say_nothing_are_clamped():
    model = to_dict(presets.tiny())
    del model["renderer"]["jacobian"]
    assert read(model) == "clamped"
    model["renderer"]["jacobian"] = "free"
    with pytest.raises(ValueError, match="renderer.jacobian: must be one of 'exact', 'clamped'"):
        read(model)


@pytest.mark.parametrize("name", ["elastic-small", "rigid-small", "cloth-small"])
def test_shipped_models_draw_as_they_were_trained(name):
    model = yaml.safe_load(located(name).with_name("config.yaml").read_text())["model"]
    assert "jacobian" in model["renderer"] or read(model) == "clamped"


def test_run_goes_on_as_it_began():
    simulator, model = make_simulator(), to_dict(CONFIG)
    keep_jacobian(simulator, model)
    assert simulator.config == CONFIG
    del model["renderer"]["jacobian"]
    keep_jacobian(simulator, model)
    assert simulator.config.renderer == dataclasses.replace(CONFIG.renderer, jacobian="clamped")


def test_model_draws_as_its_configuration_says():
    frames, images = make_frames((1,)), {}
    for jacobian in ("exact", "clamped"):
        renderer = dataclasses.replace(CONFIG.renderer, jacobian=jacobian, initial_scale=0.29)
        simulator = make_simulator(dataclasses.replace(CONFIG, renderer=renderer))
        with torch.no_grad():
            state = simulator.encode(frames)
            state.means[::2] += torch.tensor([1.5, 0.0, 0.0])  # outside of the image
            cameras = target_cameras(frames, 1)
            images[jacobian] = simulator.render(state, cameras).color
            expected = render(simulator.renderer(state), cameras, jacobian=jacobian).color
        assert torch.equal(images[jacobian], expected)
    assert not torch.equal(images["exact"], images["clamped"])
    assert RendererConfig().jacobian == "exact"
