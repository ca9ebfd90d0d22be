"""From checkpoints to simulators: what a configuration may ask for."""

import dataclasses
import os
import subprocess
import sys

import pytest
import torch

from gsim3d import Simulator, presets
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.io.checkpoint import Checkpoint, export
from gsim3d.io.settings import to_dict
from gsim3d.pretrained.loading import check_sizes
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import build_simulator, restore

ROOM = 2 * 2**30  # bytes that a child process may claim beyond what it starts with


def write_model(path, **changes):
    """A single-file checkpoint of tiny weights whose configuration has other numbers in some places."""
    config = to_dict(presets.tiny())
    for place, value in changes.items():
        part, name = place.split("__")
        config[part][name] = value
    content = {"model": config, "data": {**to_dict(DataConfig()), "image_size": [64, 64]}}
    export(Checkpoint(model=Simulator(presets.tiny()).state_dict(), config=content, state={"step": 1}), path)
    return path


LARGEST = [  # that are in range
    {"dynamics__mlp_ratio": 100},
    {"dynamics__encoder_depths": [100, 1, 1]},
    {"encoder__cnn_blocks": 100},
    {"encoder__transformer_layers": 100},
    {"encoder__cost_unet_levels": 20},
    {"encoder__n_depths": 10**4},
]
HUGE = [
    {"dynamics__mlp_ratio": 10**6},
    {"dynamics__encoder_depths": [10**9, 1, 1]},
    {"dynamics__history_bits": 10**10},
    {"encoder__cnn_blocks": 10**9},
    {"encoder__transformer_layers": 10**9},
    {"encoder__cost_unet_levels": 10**6},
    {"encoder__n_depths": 10**10},
]


def test_a_configuration_cannot_claim_memory(tmp_path):
    for i, changes in enumerate(LARGEST + HUGE):
        write_model(tmp_path / f"{i}.safetensors", **changes)
    script = (
        "import resource, sys\n"
        "from gsim3d.errors import InputError\n"
        "from gsim3d.train.restore import restore\n"
        "size = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        f"resource.setrlimit(resource.RLIMIT_AS, (size + {ROOM},) * 2)\n"
        "for file in sys.argv[1:]:\n"
        "    try:\n"
        "        restore(file)\n"
        "    except InputError as error:\n"
        "        print(error)\n"
    )
    files = [str(tmp_path / f"{i}.safetensors") for i in range(len(LARGEST + HUGE))]
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", script, *files], env=environment, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and len(lines) == len(files), done.stderr[-500:]
    for file, line in zip(files, lines, strict=True):
        assert line.startswith(f"{file}: ") and "no memory" not in line and "MemoryError" not in line
    assert all("the weights do not fit the model" in line for line in lines[: len(LARGEST)])
    assert sum(" must be at most " in line for line in lines[len(LARGEST) :]) == len(HUGE) - 1
    assert "history_bits must be from 0 to 32" in lines[len(LARGEST) + 2]


def test_a_good_configuration_is_restored(tmp_path):
    simulator = restore(write_model(tmp_path / "model.safetensors")).simulator
    assert simulator.config == presets.tiny() and not simulator.training
    assert all(value.device.type == "cpu" for value in simulator.state_dict().values())


def test_sizes_are_compared_without_memory():
    config = presets.tiny()
    weights = {name: value.to("meta") for name, value in Simulator(config).state_dict().items()}
    check_sizes(Simulator, config, EffectsSpec(), weights)
    name = next(iter(weights))
    with pytest.raises(RuntimeError, match="Missing key"):
        check_sizes(Simulator, config, EffectsSpec(), {key: value for key, value in weights.items() if key != name})
    with pytest.raises(RuntimeError, match="size mismatch"):
        check_sizes(Simulator, config, EffectsSpec(), {**weights, name: torch.empty(1, 2, 3, device="meta")})


def test_comparing_sizes_leaves_torch_as_it_was():
    config = presets.tiny()
    before = build_simulator(config, 0).state_dict()
    dynamics = dataclasses.replace(config.dynamics, mlp_ratio=100)
    with pytest.raises(RuntimeError, match="more than twice"):
        check_sizes(Simulator, dataclasses.replace(config, dynamics=dynamics), EffectsSpec(), before)
    for name, value in build_simulator(config, 0).state_dict().items():
        assert torch.equal(value, before[name])


def test_the_error_names_the_file(tmp_path):
    file = write_model(tmp_path / "model.safetensors", dynamics__mlp_ratio=3)
    with pytest.raises(InputError, match=r"model.safetensors: the weights do not fit the model: size mismatch"):
        restore(file)
