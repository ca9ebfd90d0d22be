"""Each switch of the dynamics does what it says. (That "on" is the published model is shown in tests/golden.)"""

import dataclasses

import pytest
import torch

from gsim3d.dynamics.point_transformer import Block
from gsim3d.quirks import Quirks
from tests.asserts import assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history


def with_quirks(**switches):
    return make_dynamics(dataclasses.replace(TINY, quirks=Quirks(**switches)))


def conv_inputs_and_sums(dynamics, history):
    """What the first block of the finest decoder stage convolves, and what comes into it."""
    seen = []
    block = dynamics.net.decoder[0].blocks[0]
    assert isinstance(block, Block)

    def see(_, args, kwargs):
        seen.append((kwargs["conv_input"], args[0]))

    block.register_forward_pre_hook(see, with_kwargs=True)
    dynamics(history)
    return seen[0]


@pytest.mark.parametrize("quirk", [False, True])
def test_stale_decoder_conv(quirk):
    read, summed = conv_inputs_and_sums(with_quirks(stale_decoder_conv=quirk), make_history((30, 30)))
    assert torch.equal(read, summed) == (not quirk)


@pytest.mark.parametrize("quirk", [False, True])
def test_first_of_voxel(quirk):
    dynamics = with_quirks(first_of_voxel=quirk)
    history = make_history((40,), frozen_share=0.0)
    # Rows 0 and 1 share a cell and lie next to the others; what row 1 carries reaches them through the mean only.
    means = history.means.clone()
    means[1] = means[0]
    history = dataclasses.replace(history, means=means)
    latents = history.dynamic_latents.clone()
    latents[1] += 1.0
    convs = []
    dynamics.net.stem.conv.register_forward_hook(lambda *args: convs.append(args[2]))
    dynamics(history)
    dynamics(dataclasses.replace(history, dynamic_latents=latents))
    changed = (convs[0] != convs[1]).any(1)
    assert changed[1] and changed[2:].any() == (not quirk)


@pytest.mark.parametrize("quirk", [False, True])
def test_anchor_at_minimum(quirk):
    dynamics = with_quirks(anchor_at_minimum=quirk)
    history, other = make_history((30,)), make_history((30,), seed=1)
    other = dataclasses.replace(other, means=other.means - 0.4 * TINY.grid_size)
    together = dynamics(batch([history, other])).select_clouds(torch.tensor([0]))
    assert torch.equal(together.means, dynamics(history).means) == (not quirk)


@pytest.mark.parametrize("quirk", [False, True])
def test_slots_from_first(quirk):
    dynamics = with_quirks(slots_from_first=quirk)
    seen = []
    dynamics.net.encoder[1].merge.register_forward_pre_hook(lambda _, args: seen.append(args[1].time_index))
    step = dynamics(make_history((30,)))
    assert torch.isfinite(step.means).all()
    if quirk:
        assert seen[0] is None  # one step: nothing merges
    else:
        assert_same_bits(seen[0], torch.ones_like(seen[0]))  # the newest of the pair that would merge
