"""Contact response: non-penetration, friction, and conservation of momentum by internal displacements."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import rollout
from gsim3d.errors import InputError
from gsim3d.priors import ContactConfig, InertiaConfig, ProximityConfig, SegmentationConfig, ShapeMatchingConfig
from gsim3d.priors.contact import ContactSolver
from gsim3d.state import DYNAMIC
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import batch, make_dynamics
from tests.priors.scenes import context, windows, with_priors, without_prior
from tests.priors.test_gravity import CELL, CONTACT, FALL, FLYING, GRAVITY, LENGTH, RADIUS, ball
from tests.priors.test_segmentation import bodies

pytestmark = pytest.mark.usefixtures("one_thread")

WIDE = 5.0  # metres: a window of all rows alike
FIRM = 0.5
NEAR = ProximityConfig(range=CONTACT, min_opacity=FIRM)
PUSHED = with_priors(
    dataclasses.replace(FLYING, priors=()),
    SegmentationConfig(),
    NEAR,
    InertiaConfig(radius=LENGTH),
    ShapeMatchingConfig(radius=LENGTH),
    GRAVITY,
    ContactConfig(radius=LENGTH),
)
FRICTION, SKIN = torch.tensor(1.0), torch.tensor(0.0)


def solver(history, radius=WIDE, friction=FRICTION, skin=SKIN, rigid=False):
    ctx = context(history, NEAR, grid_size=CELL)
    if history.body is None:  # one body whose particles count as evenly as those of segmented ones
        ctx.windows = lambda radius: ctx.cached("windows", lambda: windows(history, radius, CELL, evenly=True))
    numbers = (x.to(history.means) for x in (friction, skin))
    config, geometry = ContactConfig(radius=radius, rigid=rigid), ctx.priors.get("proximity").geometry(ctx)
    return ContactSolver(ctx, geometry, config, *numbers)


def moves(history, onward=0.0, motions=0.0, back=0.0, **options):
    """[N, 3]: the given values at movable particles (a vector: equal for all), 0 elsewhere."""
    moving = (history.activity == DYNAMIC)[:, None]
    rows = [torch.where(moving, torch.as_tensor(x).to(history.means), 0) for x in (onward, motions, back)]
    return solver(history, **options).displacements(*(x.expand(history.n_rows, 3) for x in rows))


def noise(history, seed=0):
    return 0.01 * torch.randn(history.n_rows, 3, generator=torch.Generator().manual_seed(seed))


def moving_places(history):
    moving = history.activity == DYNAMIC
    return moving, history.means[moving] - history.means[moving].mean(0)


def weights(history, moving):
    """Weight of each movable particle in the windows."""
    return windows(history, WIDE, CELL, evenly=True).weights[0, 0, : int(moving.sum()), None]


@pytest.mark.parametrize("what", ["motions", "back"])
def test_internal_displacements_conserve_momentum_and_spin(what):
    history = ball(1.0)
    moving, places = moving_places(history)
    found, share = moves(history, **{what: noise(history) + 0.02})[moving], weights(history, moving)
    assert found.abs().max() > 0.01
    assert (share * found).sum(0).abs().max() < 1e-4
    assert (share * torch.linalg.cross(places - (share * places).sum(0), found)).sum(0).abs().max() < 1e-5


def test_gained_displacements_near_ground_move_and_turn_body():
    history, push = ball(0.0), torch.tensor([0.02, 0.0, 0.01])
    moving, places = moving_places(history)
    found = torch.stack([moves(history, motions=x)[moving] for x in (0.0, push)]).diff(dim=0)[0]
    near = solver(history)._near[moving]
    share = weights(history, moving)
    # of all rows alike what is near the ground is kept, and the rest is none
    expected = near * push
    assert_close_relative_to_max((share * found).sum(0), (share * expected).sum(0), 0.05)
    spin = (share * torch.linalg.cross(places, found)).sum(0)
    assert_close_relative_to_max(spin, (share * torch.linalg.cross(places, expected)).sum(0), 0.05)


def test_gained_displacement_counts_once():
    history = ball(0.0)
    moving, _ = moving_places(history)
    lowest, push = history.means[moving, 2].argmin(), torch.tensor([0.0, 0.0, 0.02])
    row = torch.zeros(history.n_rows, 1).index_put((moving.nonzero()[lowest, 0],), torch.tensor(1.0))
    found = moves(history, motions=row * push)[moving][lowest]
    assert_close_relative_to_max(found, push, 0.05)


def two_balls():
    """Two segmented bodies, one on the ground and one 16 cm from it, and the mask bool [N] of the first."""
    one, other = ball(0.0), ball(0.25, n=300, seed=1)
    moves = other.activity == DYNAMIC
    other = dataclasses.replace(other, means=other.means + torch.tensor([0.5, 0.0, 0.0])).select_rows(moves)
    fields = {name: torch.cat([value, other.row_fields()[name]]) for name, value in one.row_fields().items()}
    both = dataclasses.replace(one, **fields, cu_rows=one.cu_rows + torch.tensor([0, other.n_rows]), known=None)
    first = torch.arange(both.n_rows) < one.n_rows
    return dataclasses.replace(both, body=bodies(both)), first & (both.activity == DYNAMIC)


def test_contact_of_one_body_leaves_neighboring_body():
    """Windows without segmentation would slow the other body, too."""
    history, first = two_balls()
    second = (history.activity == DYNAMIC) & ~first
    pushed = torch.where(first[:, None], torch.tensor([0.02, 0.0, 0.03]), 0)
    found = moves(history, motions=pushed + noise(history) * first[:, None], radius=0.3)
    assert found[first].abs().max() > 0.01 and found[second].abs().max() < 1e-4
    unknown = moves(dataclasses.replace(history, body=None), motions=pushed, radius=0.3)
    assert unknown[second].abs().max() > 1e-3


@pytest.mark.parametrize("which", [0, 1])
def test_segmented_windows_conserve_momentum(which):
    history, first = two_balls()
    chosen = first if which == 0 else (history.activity == DYNAMIC) & ~first
    found = windows(history, 0.3, CELL, evenly=True)
    share = found.movable.scatter(found.weights.amax(1)[:, : found.movable.positions.shape[1], None])[chosen]
    found = moves(history, back=noise(history) + 0.02, radius=0.3)[chosen]
    places = history.means[chosen] - history.means[chosen].mean(0)
    assert share.sum().item() == pytest.approx(1, abs=1e-3) and found.abs().max() > 0.01
    assert (share * found).sum(0).abs().max() < 1e-5
    assert (share * torch.linalg.cross(places - (share * places).sum(0), found)).sum(0).abs().max() < 1e-5


def test_rigid_contact_stops_whole_body():
    """A ball falls by 8 cm from a height of 2 cm; without ``rigid``, most particles would continue."""
    history = ball(0.02)
    history = dataclasses.replace(history, body=bodies(history))
    moving, places = moving_places(history)
    for solid in (False, True):
        found = moves(history, onward=[0.0, 0.0, -0.08], rigid=solid)[moving]
        squeezed = found - found.mean(0)
        height = (history.means[moving] - 1.0 + found)[:, 2]
        assert height.min() > -1e-3
        assert (found[:, 2].mean() > -0.04) == solid and (squeezed.norm(dim=1).max() < 0.02) == solid


@pytest.mark.parametrize("solid", [False, True])
def test_faint_particles_stop_no_rigid_body(solid):
    """One particle of a ball high above the ground is below the ground."""
    history = ball(0.2)
    moving = history.activity == DYNAMIC
    lowest = moving.nonzero()[history.means[moving, 2].argmin()]
    means, opacities = history.means.clone(), torch.full_like(history.opacities, FIRM)
    means[lowest, 2] = 1.0
    found = []
    for opacity in (FIRM, 0.9 * FIRM):
        opacities[lowest] = opacity
        changed = dataclasses.replace(history, means=means, opacities=opacities.clone())
        changed = dataclasses.replace(changed, body=bodies(changed))
        found.append(moves(changed, onward=[0.0, 0.0, -0.05], rigid=solid))
    stopped = [x[moving, 2] + 0.05 for x in found]
    assert stopped[0].max() > 0.049 and (stopped[0].median() > 0.01) == solid
    assert (stopped[1].abs().max() < 1e-6) if solid else torch.equal(*found)


def test_rigid_contact_at_one_end_turns_body():
    history = ball(0.02)
    moving = history.activity == DYNAMIC
    slope = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    middle = torch.tensor([1.0, 1.0, 1.22])
    stick = (history.means - middle) * torch.tensor([1.0, 0.2, 0.2]) @ slope.T
    stick = stick + middle - torch.tensor([0.0, 0.0, 0.05])
    history = dataclasses.replace(history, means=torch.where(moving[:, None], stick, history.means))
    history = dataclasses.replace(history, body=bodies(history))
    found = moves(history, onward=[0.0, 0.0, -0.08], friction=torch.tensor(0.0), rigid=True)[moving]
    down = history.means[moving, 2] < 1.1
    up = history.means[moving, 2] > 1.25
    assert down.any() and up.any() and found[up, 2].mean() < found[down, 2].mean() - 0.02


@pytest.mark.parametrize("skin", [0.0, 0.02])
def test_contact_stops_particles_at_offset(skin):
    """A ball falls by 8 cm from a height of 2 cm."""
    history = ball(0.02)
    moving, _ = moving_places(history)
    found = moves(history, onward=[0.03, 0.0, -0.08], skin=torch.tensor(skin))[moving]
    height = (history.means[moving] - 1.0)[:, 2]
    stopped = height < 0.08 + skin
    assert 2 < stopped.sum() < 0.6 * len(height)
    assert_close_relative_to_max(height[stopped] + found[stopped, 2], torch.full_like(height[stopped], skin), 2e-3)
    strong = 0.08 + skin - height > 0.03  # friction is as large as what stops them
    assert strong.any() and found[strong, 0].abs().max() < 1e-3
    assert_close_relative_to_max(found[~stopped], torch.tensor([0.03, 0.0, -0.08]).expand_as(found[~stopped]), 1e-4)


def test_friction_limits_tangential_loss():
    history = ball(0.0)
    moving, _ = moving_places(history)
    lowest = history.means[moving, 2].argmin()
    height = history.means[moving, 2][lowest].item() - 1.0
    for friction in (0.0, 0.5, 4.0):
        found = moves(history, onward=[0.04, 0.0, -0.06], friction=torch.tensor(friction))[moving][lowest]
        left = max(0.0, 0.04 - friction * (0.06 - height))
        assert found[0].item() == pytest.approx(left, abs=2e-3) and found[2].item() == pytest.approx(-height, abs=2e-3)


def test_particles_below_ground_may_stay_or_rise():
    history = ball(-0.03)
    moving, _ = moving_places(history)
    lowest = history.means[moving, 2].argmin()
    down, up = (moves(history, onward=[0.0, 0.0, z])[moving][lowest, 2] for z in (-0.02, 0.02))
    assert down.abs() < 1e-3 and up.item() == pytest.approx(0.02, abs=1e-4)


def test_untrained_ball_bounces():
    dynamics = make_dynamics(PUSHED)
    torch.nn.init.zeros_(dynamics.net.head.fc2.weight), torch.nn.init.zeros_(dynamics.net.head.fc2.bias)
    history = ball(0.1, (0.01, 0.0, -0.04))
    moving, _ = moving_places(history)
    steps = [history, *rollout(dynamics, history, 16, max_steps=2)]
    heights = torch.stack([step.means[moving, 2] - 1.0 for step in steps])
    sizes = heights.amax(1) - heights.amin(1)
    centre = heights.mean(1)
    assert heights.min() > -0.01
    assert sizes.min() < 0.85 * 2 * RADIUS and sizes[-1] > 0.9 * 2 * RADIUS
    lowest = centre.argmin()
    assert 2 < lowest < 12 and centre[-1] > centre[lowest] + 0.05
    assert centre[-1] < centre[0]  # what it had at first it does not get back
    assert_close_relative_to_max(centre[1] - centre[0], torch.tensor(-0.04 + FALL[2]), 0.02)


def test_contact_of_batch_equals_single_scenes():
    one, other = ball(0.0), ball(0.0, n=200, seed=3)
    both = batch([one, other])
    motions = [noise(history, seed) for seed, history in enumerate((one, other))]
    found = solver(both, 0.2).displacements(0 * torch.cat(motions), torch.cat(motions), 0 * torch.cat(motions))
    alone = [solver(h, 0.2).displacements(0 * c, c, 0 * c) for c, h in zip(motions, (one, other))]
    assert_close_relative_to_max(found, torch.cat(alone), 1e-4)
    rests = both.activity != DYNAMIC
    assert_same_bits(found[rests], torch.cat(motions)[rests])


@pytest.mark.parametrize("solid", [False, True])
def test_gradients(solid):
    history = dataclasses.replace(ball(0.01, n=20), velocity=None, rest_positions=None)
    history = dataclasses.replace(history, means=history.means.double())
    moving = history.activity == DYNAMIC
    rows = [torch.where(moving[:, None], noise(history, seed).double(), 0)[moving] for seed in range(3)]
    rows[0] = rows[0] + torch.tensor([0.02, 0.01, -0.03])
    numbers = [torch.tensor(x, dtype=torch.float64) for x in (0.7, 0.01)]
    inputs = [x.requires_grad_() for x in (*rows, *numbers)]

    def found(onward, motions, back, friction, skin):
        at = moving.nonzero()[:, 0]
        full = [torch.zeros_like(history.means).index_put((at,), x) for x in (onward, motions, back)]
        return solver(history, 0.3, friction, skin, solid).displacements(*full)[moving]

    assert torch.autograd.gradcheck(found, inputs)


def test_stopped_height_has_no_gradient_to_position():
    history = ball(0.02)
    means = history.means.clone().requires_grad_()
    history = dataclasses.replace(history, means=means)
    moving = history.activity == DYNAMIC
    found = (means + moves(history, onward=[0.0, 0.0, -0.05]))[moving]
    lowest = found[:, 2].argmin()
    (grad,) = torch.autograd.grad(found[lowest, 2], means)
    assert grad[moving][lowest].abs().max() < 1e-2


@pytest.mark.parametrize("share", ["own motion", "way back"])
def test_gain_gradient_matches_finite_difference(share):
    """Objective: height of a compressed ball that bounces."""
    history = ball(0.1, (0.02, 0.0, -0.06), (0.03, 0.06, 0.0))
    dynamics = make_dynamics(PUSHED)
    name, begin = {"own motion": ("inertia", 6), "way back": ("shape_matching", 0)}[share]
    last = dynamics.priors.get(name).gain_head
    chosen = torch.zeros(last.out_features).index_fill(0, torch.arange(begin, begin + 3), 1.0)
    del last.bias

    def height(kept):
        last.bias = kept * chosen
        return rollout(dynamics, history, 12, max_steps=2)[-1].means[history.activity == DYNAMIC, 2].mean()

    kept = torch.tensor(0.0, requires_grad=True)
    (grad,) = torch.autograd.grad(height(kept), kept)
    with torch.no_grad():
        slope = (height(torch.tensor(0.04)) - height(torch.tensor(-0.04))) / 0.08
    assert grad.item() == pytest.approx(slope.item(), rel=0.35) and slope > 0.02


def test_proximity_gradient_matches_finite_difference():
    history, push = ball(0.02), torch.tensor([0.02, 0.0, 0.0])
    moving, _ = moving_places(history)
    share = weights(history, moving)

    def moved(raised):
        means = history.means + raised * moving[:, None] * torch.tensor([0.0, 0.0, 1.0])
        return (share * moves(dataclasses.replace(history, means=means), motions=push)[moving]).sum(0)[0]

    raised = torch.tensor(0.0, requires_grad=True)
    (grad,) = torch.autograd.grad(moved(raised), raised)
    with torch.no_grad():
        slope = (moved(torch.tensor(0.004)) - moved(torch.tensor(-0.004))) / 0.008
    assert grad.item() == pytest.approx(slope.item(), rel=0.1) and slope < -0.005


def test_flight_is_unchanged_by_contact():
    history = ball(2.0, (0.03, 0.01, 0.02), (0.0, 0.05, 0.0))
    one, other = (make_dynamics(config) for config in (PUSHED, FLYING))
    for dynamics in (one, other):
        torch.nn.init.zeros_(dynamics.net.head.fc2.weight), torch.nn.init.zeros_(dynamics.net.head.fc2.bias)
    ways = [(rollout(dynamics, history, 5, max_steps=2)[-1].means - history.means) for dynamics in (one, other)]
    moving = history.activity == DYNAMIC
    assert_close_relative_to_max(ways[0][moving], ways[1][moving], 0.02)


def test_contact_parameters_have_gradients():
    history = ball(0.0, (0.03, 0.0, -0.02))
    dynamics = make_dynamics(PUSHED)
    (step,) = rollout(dynamics, history, 1, max_steps=2)
    step.means.square().sum().backward()
    for parameter in (
        dynamics.priors.get("contact").friction,
        dynamics.priors.get("contact").offset,
        dynamics.priors.get("gravity").acceleration,
        dynamics.priors.get("inertia").gain_head.weight,
    ):
        assert parameter.grad.isfinite().all() and parameter.grad.abs().sum() > 0


def test_contact_of_empty_scene():
    history = ball(0.02)
    empty = history.select_rows(torch.zeros(history.n_rows, dtype=torch.bool))
    assert make_dynamics(PUSHED)(empty).means.shape == (0, 3)
    found = moves(ball(0.0, ground=False), onward=[0.0, 0.0, -0.05])
    assert_close_relative_to_max(found, torch.tensor([0.0, 0.0, -0.05]).expand_as(found), 1e-6)


def test_transparent_background_stops_no_particle():
    history = ball(0.02)
    moving, _ = moving_places(history)
    for opacity, stops in ((FIRM - 0.01, False), (FIRM + 0.01, True)):
        opacities = torch.where(moving.reshape(history.opacities.shape), history.opacities, opacity)
        found = moves(dataclasses.replace(history, opacities=opacities), onward=[0.0, 0.0, -0.08])[moving]
        assert (found[:, 2] > -0.07).any() == stops


def test_contact_on_gpu(devices):
    history = ball(0.01)
    expected, actual, again = (
        moves(history.to(d), onward=[0.01, 0.0, -0.03], motions=noise(history).to(d), radius=0.2).cpu()
        for d in (*devices, devices[1])
    )
    assert_close_relative_to_max(actual, expected, 1e-3)
    assert_same_bits(again, actual)


def test_compiled(device):
    history = ball(0.0, n=60).to(device)
    motions = noise(history.to("cpu")).to(device)
    history.clouds

    def found(motions, history):
        return solver(history, 0.2).displacements(motions, motions, motions)

    expected = found(motions, history)
    assert_close_relative_to_max(torch.compile(found, fullgraph=True)(motions, history), expected, 1e-3)


@pytest.mark.parametrize("name", ["segmentation", "proximity", "inertia"])
def test_contact_needs_other_priors(name):
    config = without_prior(PUSHED, "gravity")
    with pytest.raises(InputError, match=f"contact needs {name} before it"):
        without_prior(config, name)


def test_even_windows_weigh_particles_by_surface():
    """Only one in five particles of the lower half of a ball is present."""
    history = ball(1.0, n=800)
    moving, _ = moving_places(history)
    height = history.means[:, 2] - 2.0 - RADIUS
    seen = ~moving | (height > 0) | (torch.arange(history.n_rows) % 5 == 0)
    history, height = history.select_rows(seen), height[seen & moving]
    found = [windows(history, 0.4, CELL, evenly=even).weights[0, :, : len(height)] for even in (False, True)]
    alike, evenly = ((window @ height).mean() for window in found)
    assert alike > 0.2 * RADIUS and evenly.abs() < 0.5 * alike
