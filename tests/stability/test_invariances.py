"""Invariances of the simulator (gsim3d/testing/invariances.py)."""

import dataclasses

import pytest
import torch

from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.priors import (
    ContactConfig,
    GravityConfig,
    InertiaConfig,
    ProximityConfig,
    SegmentationConfig,
    ShapeMatchingConfig,
    VelocityConfig,
    VelocityFromImagesConfig,
)
from gsim3d.priors.padding import SAMPLES
from gsim3d.simulator import Simulator
from gsim3d.state import DYNAMIC
from gsim3d.testing import invariances
from gsim3d.testing.invariances import INVARIANCES, Sample, take_scenes
from tests.dynamics.scenes import EXPLICIT
from tests.priors.scenes import OCCLUSION
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator, target_cameras

pytestmark = pytest.mark.usefixtures("one_thread")

HISTORIES = (2, 3, 1)
EXPLICIT_CONFIG = dataclasses.replace(
    CONFIG,
    encoder=dataclasses.replace(CONFIG.encoder, explicit=True, sh_degree=1, dynamic_dim=4, static_dim=3),
    dynamics=dataclasses.replace(EXPLICIT, grid_size=0.1),
    renderer=dataclasses.replace(CONFIG.renderer, latents=0),
)
SEEN = VelocityFromImagesConfig(), InertiaConfig(), ShapeMatchingConfig()
MOVING = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, priors=(*SEEN, OCCLUSION)))
PUSHED = (SegmentationConfig(), ProximityConfig(), *SEEN, GravityConfig(), ContactConfig(), OCCLUSION)
CARRIED = (VelocityFromImagesConfig(), VelocityConfig())
CARRIED = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, priors=CARRIED))
CONFIGS = {"latent": CONFIG, "explicit": EXPLICIT_CONFIG, "moving": MOVING, "carried": CARRIED}


def make_sample(device, dtype=torch.float32, n_steps=3, plan=None):
    frames = make_frames(HISTORIES).to(device)
    frames = dataclasses.replace(frames, images=frames.images.to(dtype))
    return Sample(frames, target_cameras(frames, len(HISTORIES)).to(device), n_steps, plan)


@pytest.fixture(scope="module")
def simulators():
    """Weights of which none is zero, by model and dtype."""
    return {
        (name, dtype): awake(make_simulator(config)).to(dtype)
        for name, config in CONFIGS.items()
        for dtype in (torch.float32, torch.float64)
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("model", CONFIGS)
@pytest.mark.parametrize("name", INVARIANCES)
def test_invariance(name, model, dtype, device, simulators):
    deviations = list(INVARIANCES[name](simulators[model, dtype].to(device), make_sample(device, dtype)))
    assert deviations
    broken = [str(deviation) for deviation in deviations if not deviation.holds]
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize("background", ["masked_out", "dynamic"])
@pytest.mark.parametrize("name", ["permute scenes", "split the batch", "append a far particle"])
def test_invariance_for_every_background(name, background, device, simulators):
    simulator = simulators["latent", torch.float32].to(device)
    plan = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(background=background)))
    assert all(deviation.holds for deviation in INVARIANCES[name](simulator, make_sample(device, plan=plan)))


# In float64: in float32, rounding may exchange two particles along the curve of samples, and one of them is a sample.
@pytest.mark.parametrize("model", ["moving", "carried"])
@pytest.mark.parametrize("name", ["permute particles", "permute views"])
def test_invariance_of_more_particles_than_samples(name, model, device, simulators):
    simulator = simulators[model, torch.float64].to(device)
    frames = make_frames((2, 3), n_views=8, masked=False).to(device)
    frames = dataclasses.replace(frames, images=frames.images.double())
    state = simulator.encode(frames)
    assert all((state.select_clouds([q]).activity == DYNAMIC).sum() > SAMPLES for q in range(state.n_clouds))
    broken = [str(x) for x in INVARIANCES[name](simulator, Sample(frames, target_cameras(frames, 2))) if not x.holds]
    assert not broken, "\n".join(broken)


# Bodies of noise that are stopped amplify the rounding of sums in another order: of rows in another one.
@pytest.mark.parametrize("name", [name for name in INVARIANCES if name != "permute particles"])
def test_invariance_with_contact(name, device):
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, priors=PUSHED))
    # Products of a GPU are rounded by the batch: one step does not amplify that.
    sample = make_sample(device, n_steps=1 if device != "cpu" and name == "split the batch" else 3)
    broken = [str(x) for x in INVARIANCES[name](awake(make_simulator(config)).to(device), sample) if not x.holds]
    assert not broken, "\n".join(broken)


class Broken(Simulator):
    """Breaks every invariance a little: predictions depend on batch mates, row numbers and absolute positions."""

    def _predict(self, *args, **kwargs):
        step = super()._predict(*args, **kwargs)
        row = torch.arange(step.n_rows, device=step.means.device)[:, None]
        touched = step.dynamic_latents + 1e-2 * (step.means.sum() + 0.01 * row)
        return dataclasses.replace(step, dynamic_latents=touched + 1e-2 * torch.rand_like(touched))

    def encode(self, *args, **kwargs):
        state = super().encode(*args, **kwargs)
        row = torch.arange(state.n_rows, device=state.means.device)[:, None]
        return dataclasses.replace(state, means=state.means + 0.01 * state.means.square() + 1e-4 * row)


@pytest.mark.parametrize("name", INVARIANCES)
def test_invariance_detects_broken_simulator(name):
    torch.manual_seed(0)
    broken = [d for d in INVARIANCES[name](awake(Broken(CONFIG).eval()), make_sample("cpu")) if not d.holds]
    assert broken and all(":" in str(deviation) for deviation in broken)


def test_deviation_names_worst_particle():
    simulator = make_simulator()
    state = simulator.encode(make_frames((1, 2)))
    other = state.means.clone()
    row = int(state.cu_rows[2]) + 5
    other[row, 1] = float("nan")
    (found,) = invariances.compare_particles("encode", dataclasses.replace(state, means=other), state, 1e-3, ["means"])
    assert not found.holds and found.where == "scene 1, step 1, particle 5"
    both = dataclasses.replace(state, means=other)
    assert not next(invariances.compare_particles("encode", both, both, 0, ["means"])).holds


def test_take_scenes_repeats_and_reorders():
    frames = make_frames((2, 1))
    taken = take_scenes(frames, [1, 0, 1])
    assert taken.cloud_scene.tolist() == [0, 1, 1, 2] and taken.cloud_step.tolist() == [0, 0, 1, 0]
    assert torch.equal(taken.images[:2], frames.images[4:]) and torch.equal(taken.images[2:6], frames.images[:4])
    assert taken.cameras.image_cloud.tolist() == [0, 0, 1, 1, 2, 2, 3, 3] and len(taken.origin) == 3
