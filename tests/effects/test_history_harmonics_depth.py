"""A history of one step merges nothing; harmonics of degree 0 see no directions; depth is a channel, no second pass."""

import pytest
import torch

from gsim3d.dynamics import Dynamics
from gsim3d.effects.plan import make_plan, unused_parameters
from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec, OutputEffects
from gsim3d.presets import paper_latent
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import make_dynamics, make_history
from tests.effects.counting import counted
from tests.test_simulator import make_frames, make_simulator, target_cameras

pytestmark = pytest.mark.usefixtures("one_thread")


def test_history_of_one_merges_nothing(monkeypatch):
    """No index of steps, no product with the table of marks, and the bits of the network that does merge."""
    dynamics, history = make_dynamics(), make_history((40,))
    with torch.no_grad(), counted() as alone:
        step = dynamics(history)
    assert all(stage.time_index is None for stage in dynamics.geometry(history).stages)
    monkeypatch.setattr(Dynamics, "_slots", lambda *_: ((3,), 2))
    with torch.no_grad(), counted() as merging:
        merged = dynamics(history)
    spared = merging.calls - alone.calls
    assert spared["aten.mm.default"] == 2, "one product with a table of marks for each stage that merges"
    for name, value in step.row_fields().items():
        assert_same_bits(value, getattr(merged, name), name)


def test_history_of_one_needs_no_time_embedding():
    one = paper_latent(1)
    names = [f"dynamics.net.encoder.{s}.merge.time_embedding" for s in range(1, 5)]
    assert unused_parameters(make_plan(EffectsSpec(), one), one, names) == tuple(names)
    four = paper_latent(4)
    less = make_plan(EffectsSpec(dynamics=DynamicsEffects(history=1)), four)
    assert unused_parameters(less, four, names) == tuple(names[2:]), "the mark of the newest step stays"


def make_render():
    """A function that renders a state of a model with harmonics of degree 1 under a spec, and what it called."""
    simulator, frames = make_simulator(), make_frames((1,))
    state = simulator.encode(frames)

    def render(degree, **outputs):
        spec = EffectsSpec(appearance=AppearanceEffects(view_dependent=degree), outputs=OutputEffects(**outputs))
        plan = simulator.plan(spec)
        with torch.no_grad(), counted() as count:
            return simulator._draw(state, target_cameras(frames, 1), plan=plan), count

    return render


def test_degree_zero_computes_no_view_direction():
    """The head has fewer columns, and nothing is turned."""
    render = make_render()
    (_, one), (image, zero) = render(1), render(0)
    assert zero.calls["gsim3d.rasterize_gaussians.default"] == one.calls["gsim3d.rasterize_gaussians.default"] == 1
    assert one.calls["gsim3d.decode_gaussians.default"] == zero.calls["gsim3d.decode_gaussians.default"] == 1
    assert zero.bytes < one.bytes
    assert image.color.max() > 0.05


def test_depth_shares_rasterization_pass():
    render = make_render()
    (plain, off), (both, on) = render(1), render(1, depth=True, alpha=True, features=True)
    for count in (off, on):
        assert count.calls["gsim3d.rasterize_gaussians.default"] == 1
    assert plain.depth is None and plain.alpha is None and plain.features is None
    assert both.depth.shape == both.alpha.shape == (1, 16, 16) and both.features.shape == (1, 16, 16, 7)
    assert_same_bits(plain.color, both.color)
    only, without = render(1, rgb=False, depth=True)
    assert only.color is None and without.bytes < off.bytes
    assert_close_relative_to_max(only.depth, both.depth, 1e-6)
