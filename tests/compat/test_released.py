"""Names of published weights: every one, in both directions."""

import ast
import csv
import json

import pytest
import torch

from gsim3d import presets
from gsim3d.compat.released import from_published, harmonics_matrix, to_published
from gsim3d.compat.released_import import published_shapes
from gsim3d.math.spherical_harmonics import sh_basis
from gsim3d.simulator import Simulator
from tests.asserts import assert_close_relative_to_max
from tests.compat.release import full_config, random_weights, small_config
from tests.golden_files import golden_path

# file of the published names, preset, its arguments, entries, learned parameters
VARIANTS = [
    ("keys_latent_64_64", "paper_latent", (4, 64), 978, 57_992_185),
    ("keys_latent_32_32", "paper_latent", (4, 32), 978, 57_576_665),
    ("keys_explicit_0", "paper_explicit", (4, 0), 967, 57_576_607),
    ("keys_explicit_static16", "paper_explicit", (4, 16), 973, 57_724_921),
]


def n_parameters(shapes):
    buffers = ("running_mean", "running_var", "num_batches_tracked")
    return sum(torch.Size(shape).numel() for name, shape in shapes.items() if not name.endswith(buffers))


@pytest.mark.parametrize(("file", "preset", "arguments", "entries", "parameters"), VARIANTS)
def test_presets_have_the_published_counts(file, preset, arguments, entries, parameters):
    shapes = published_shapes(full_config(preset, *arguments))
    assert len(shapes) == entries and n_parameters(shapes) == parameters
    assert sum(name.endswith("num_batches_tracked") for name in shapes) == 13


@pytest.mark.golden
@pytest.mark.parametrize(("file", "preset", "arguments", "entries", "parameters"), VARIANTS)
def test_presets_have_the_published_names_and_shapes(file, preset, arguments, entries, parameters):
    with open(golden_path(f"../reference/{file}.tsv"), newline="") as lines:
        published = {row["name"]: ast.literal_eval(row["shape"]) for row in csv.DictReader(lines, delimiter="\t")}
    assert published_shapes(full_config(preset, *arguments)) == published


@pytest.mark.golden
def test_full_model_is_the_released_one():
    listed = json.loads(golden_path("params_full.json").read_text())["full_latent_4_1_12_intended"]
    published = {entry["name"]: tuple(entry["shape"]) for entry in listed["entries"]}
    shapes = published_shapes(full_config("paper_latent", 4, 64))
    assert shapes == published
    assert n_parameters(shapes) == listed["param_count_total"]


def test_length_of_history_changes_no_parameter():
    shapes = [published_shapes(presets.paper_latent(n)) for n in (1, 2, 4, 8)]
    assert all(other == shapes[0] for other in shapes)
    with pytest.raises(ValueError, match="1, 2, 4 or 8"):
        presets.paper_latent(3)


def test_small_has_about_four_million_parameters():
    with torch.device("meta"):
        n = sum(p.numel() for p in Simulator(presets.small()).parameters())
    assert 3.5e6 < n < 4.5e6


@pytest.mark.parametrize("steps_per_call", [1, 2])
@pytest.mark.parametrize(("explicit", "dynamic", "static"), [(False, 4, 3), (False, 4, 0), (True, 0, 2), (True, 0, 0)])
def test_weights_round_trip(explicit, dynamic, static, steps_per_call):
    config = small_config(explicit, dynamic, static, steps_per_call=steps_per_call)
    published = random_weights(config)
    ours = from_published(published, config)
    simulator = Simulator(config)
    assert {name: value.shape for name, value in ours.items()} == {
        name: value.shape for name, value in simulator.state_dict().items()
    }
    back = to_published(ours, config)
    assert back.keys() == published.keys()
    for name, value in published.items():
        if explicit and (name.endswith("stem.conv.weight") or ".fc2." in name and ".mlp." not in name):
            assert_close_relative_to_max(back[name], value, 1e-6, name)  # through two changes of basis
        else:
            assert torch.equal(back[name], value), name


def test_harmonics_matrix_keeps_colours():
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator).double(), dim=1)
    coefficients = torch.randn(16, 3, generator=generator).double()
    published_basis = sh_basis(directions[:, [2, 0, 1]], 3)
    colours = sh_basis(directions, 3) @ (harmonics_matrix(3) @ coefficients)
    torch.testing.assert_close(colours, published_basis @ coefficients, rtol=0, atol=1e-12)
    matrix = harmonics_matrix(3)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)


def test_explicit_dynamics_say_the_same_in_either_basis():
    """The stem reads, and the head writes, harmonics of the standard basis as it did those of the published one."""
    config = small_config(explicit=True, dynamic=0, static=2, steps_per_call=2)
    published = random_weights(config)
    ours = from_published(published, config)
    wide = torch.block_diag(*[harmonics_matrix(3)] * 3)
    channels = torch.randn(20, 58, generator=torch.Generator().manual_seed(1)).double()
    turned = torch.cat([channels[:, :48] @ wide.T, channels[:, 48:]], 1)

    def stem(weights, name, x):
        return x @ weights[name][:, 2, 2, 2].double().T

    theirs = stem(published, "dynamic_model.net.embedding.stem.conv.weight", channels)
    assert_close_relative_to_max(stem(ours, "dynamics.net.stem.conv.weight", turned), theirs, 1e-6)
    x = torch.randn(20, 8, generator=torch.Generator().manual_seed(2)).double()
    theirs, mine = (
        x @ weights[f"{prefix}.weight"].double().T + weights[f"{prefix}.bias"].double()
        for weights, prefix in ((published, "dynamic_model.net.dec.2.fc2"), (ours, "dynamics.net.head.fc2"))
    )
    for first in (0, 58):  # of each of the two steps
        assert_close_relative_to_max(mine[:, first : first + 48], theirs[:, first : first + 48] @ wide.T, 1e-6)
        assert torch.equal(mine[:, first + 48 : first + 58], theirs[:, first + 48 : first + 58])


def test_published_head_has_no_bias_in_its_last_layer():
    config = small_config()
    weights = from_published(random_weights(config), config)
    weights["renderer.fc2.bias"] = torch.ones_like(weights["renderer.fc2.bias"])
    again = from_published(to_published(weights, config), config)
    assert not again["renderer.fc2.bias"].any()
