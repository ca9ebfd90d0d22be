"""Rules that update a state from a prediction (g_*) and whole rollouts (k_*) against the published ones."""

import dataclasses

import pytest
import torch
from torch.nn import functional as F

from gsim3d.compat.released_model import ReleasedDynamicsConfig, as_released
from gsim3d.dynamics import Dynamics, rollout
from gsim3d.dynamics.step import StateLayout
from gsim3d.math.spherical_harmonics import degree_damping
from gsim3d.state import FROZEN, last_steps
from tests.asserts import relative_to_max
from tests.golden.published import NOT_IN_GOLDEN, close, dynamics_config, particles_of, renamed
from tests.golden_files import golden

pytestmark = pytest.mark.golden

FIELDS = {
    "means": "means",
    "rotations": "quats",
    "scales": "scales",
    "opacities": "opacities",
    "harmonics": "sh",
    "dynamic_latent_features": "dynamic_latents",
}
PREDICTS = {"z_x": "absolute", "cx_x": "from_newest", "cx_dx": "from_previous"}


def layout_of(g, bias, modality, n_steps):
    metric = float(g["metric"])
    config = ReleasedDynamicsConfig(
        explicit=True,
        sh_degree=int(len(g["sh_mask"]) ** 0.5) - 1,
        scale_min=float(g["scale_min"]),
        scale_max=float(g["scale_max"]),
        max_step=metric / 2 if bias else None,
        predicts=PREDICTS[modality],
        steps_per_call=n_steps,
    )
    return StateLayout.of(config)


def from_published(key, value):
    """[..., N, *published shape] -> [..., N, *ours]."""
    if key == "opacities":
        return value[..., 0]
    if key == "harmonics":
        return value.mT
    return value.roll(1, -1) if key == "rotations" else value


CASES = [
    (bias, key, modality, n_steps, static)
    for bias in (0, 1)
    for key in FIELDS
    for modality in PREDICTS
    for n_steps in (1, 3)
    for static in (0, 1)
    if (key, modality, n_steps, static) != ("rotations", "z_x", 3, 0)  # the published rule raises
]


@pytest.mark.parametrize(("bias", "key", "modality", "n_steps", "static"), CASES)
def test_update_rules(bias, key, modality, n_steps, static):
    """The published rules take any number of newest states at once; each of theirs is a row here.

    With one step a call they ignore ``static_float`` of rotations. Absolute rotations have any length there.
    """
    g = golden("g_state_updates")
    layout = layout_of(g, bias, modality, n_steps)
    c = g / f"bias{bias}" / key / modality / f"npred{n_steps}" / f"static{static}"
    past, predicted = c["past"][0], c["pred"][0]  # [n, N, ...], [steps, n, N, ...]
    newest = from_published(key, past.flatten(0, 1))
    predicted = predicted.flatten(1, 2).flatten(2)
    assert len(predicted) == n_steps
    expected = from_published(key, c["out"][0].reshape(n_steps, -1, *past.shape[2:]))
    if (key, modality) == ("rotations", "z_x"):
        expected = F.normalize(expected, dim=-1)
    everything = torch.ones(1, newest.shape[0], 1)
    share = c["static_float"][0].flatten(1, 2) if static else everything
    later = layout.later_values(FIELDS[key], newest, predicted, share)
    if key == "rotations" and n_steps == 1 and static:
        assert relative_to_max(later, expected) > 1e-3
        later = layout.later_values(FIELDS[key], newest, predicted, everything)  # what frozen_rows_turn does
    close(later, expected, key)


def test_damping_of_harmonics():
    mask = golden("g_state_updates")["sh_mask"]
    close(degree_damping(int(len(mask) ** 0.5) - 1, mask), mask, "damping")


def test_batches_do_not_mix():
    """The published rule adds every prediction to every past state; here they belong together by their rows."""
    g = golden("g_state_updates")
    layout = layout_of(g, 0, "cx_x", 1)
    c = g / "quirk_B2_npred1_means_cx_x"
    past, predicted, published = c["past"], c["pred"], c["out_bias0"]
    share = torch.ones(past.shape[2], 1)
    for state in range(len(past)):
        for prediction in range(len(past)):
            (later,) = layout.later_values("means", past[state, 0], predicted[prediction, 0], share)
            close(later, published[prediction, state], f"state {state}, prediction {prediction}")


def load_dynamics(g):
    config = dataclasses.replace(
        dynamics_config("small"), grid_size=float(g["grid_size"]), max_step=float(g["metric"]) / 2
    )
    dynamics = as_released(Dynamics(config), NOT_IN_GOLDEN).eval()
    dynamics.net.load_state_dict(renamed(g / "w"))
    return dynamics


def assert_published_steps(steps, c, kept):
    """kept: [B, N], the rows of the newest step that are not masked."""
    for i, step in enumerate(steps):
        published = {
            "means": step.means,
            "dynamic_latent_features": step.dynamic_latents,
            "opacities": step.opacities[:, None],
            "static_latent_features": step.static_latents,
        }
        for name, value in published.items():
            close(value, c[f"out/{name}"][:, i][kept], f"{name} of step {i}")


@pytest.mark.parametrize("case", ["scene0_plain", "scene1_plain", "scene0_mask_static"])
@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_rollout(file, case, device):
    g = golden(f"k_rollout_{file}")
    dynamics = load_dynamics(g).to(device)
    c = g / case
    history, mask = particles_of(c)
    history = history.to(device)
    n_history, n_steps = mask.shape[1], c["out/means"].shape[1]
    calls = []

    def predict(particles):
        calls.append(particles)
        return dynamics(particles)

    network_outputs = []
    dynamics.net.register_forward_hook(lambda net, _, features: network_outputs.append(net.head(features)))
    packed = torch.cat(dynamics.layout.input_columns(history), 1)
    close(packed, c["step0/net_in_features"][mask], "features that the network reads")
    with torch.no_grad():
        steps = rollout(predict, history, n_steps, n_history)
    kept = mask[:, -1]
    assert_published_steps(steps, c, kept)
    for i, output in enumerate(network_outputs):
        seen = torch.cat([mask[:, i:], kept[:, None].expand(-1, i, -1)], 1)  # simulated steps have the newest rows
        assert torch.equal(calls[i].cu_rows.diff().cpu(), seen.sum(2).flatten())
        close(output, c[f"step{i}/net_out"][seen], f"output of the network in step {i}")
        if "in/state_mask" in c:
            assert torch.equal(c[f"step{i}/net_in_state_mask"][..., 0], seen)
            assert torch.equal(c["out/state_mask"][:, i, :, 0], kept)
            moves = (steps[i].activity != FROZEN).float().cpu()
            assert torch.equal(c["out/static_float"][:, i, :, 0][kept], moves)


@pytest.mark.parametrize("file", ["nodup", "dup"])
def test_batch_of_two_but_for_the_state_that_all_start_from(file):
    """The published batch adds every scene's change to the state of scene 0. Imitated here only, all else is equal."""
    g = golden(f"k_rollout_{file}")
    dynamics = load_dynamics(g)
    c = g / "quirk_batch2_plain"
    history, mask = particles_of(c)
    n_scenes, n_history, n = mask.shape

    def predict(particles):
        step, newest = dynamics(particles), last_steps(particles, 1)
        mixed = {
            name: getattr(newest, name)[:n].repeat(n_scenes, 1) + getattr(step, name) - getattr(newest, name)
            for name in ("means", "dynamic_latents")
        }
        return dataclasses.replace(step, **mixed)

    with torch.no_grad():
        steps = rollout(predict, history, c["out/means"].shape[1], n_history)
    assert_published_steps(steps, c, mask[:, -1])
