"""Every policy on hostile frames, cameras, origins and particles: finite outputs and gradients, or a typed error."""

import dataclasses

import pytest
import torch

from gsim3d import GradientError, InputError, NumericalError
from gsim3d.numerics.policy import StabilityConfig
from gsim3d.numerics.report import StabilityReport
from gsim3d.numerics.validate import validate_particles
from tests.test_simulator import awake, make_frames, make_simulator, target_cameras

NAN, INF = float("nan"), float("inf")
POLICIES = ("raise", "drop", "clamp")
SCENES = (1, 2)
TYPED = (NumericalError, InputError, GradientError)
NUMBERS = (NAN, INF, -INF, 0.0, -1.0, 1e-38, 1e-12, 1e4, 1e6, 1e12, 1e19, 1e30, 3e38)


@pytest.fixture(scope="module")
def simulator(one_thread):
    return awake(make_simulator())


def check(simulator, call):
    """Runs ``call``, a function of a report, forward and backward; whether it ended with a typed error."""
    try:
        outputs, leaves = call(StabilityReport())
        outputs = [value for value in outputs if value.is_floating_point()]
        assert all(bool(value.isfinite().all()) for value in outputs)
        loss = sum(value.double().atan().sum() for value in outputs if value.requires_grad)
        leaves = [*simulator.parameters(), *leaves]
        for grad in torch.autograd.grad(loss, leaves, allow_unused=True):
            assert grad is None or bool(grad.isfinite().all())
    except TYPED as error:
        assert "\n" not in str(error)
        return True
    return False


def encoded_and_simulated(simulator, frames, on_invalid):
    """What comes out of frames, from encoding to the image of the second step."""

    def call(report):
        options = {"on_invalid": on_invalid, "report": report}
        state = simulator.encode(frames, **options)
        steps = simulator.rollout(state, 2, **options)
        images = simulator.render(steps[-1], target_cameras(make_frames(SCENES), 2), **options)
        return [*steps[-1].row_fields().values(), images.color, images.depth], []

    return call


def hostile_frames():
    """name -> frames of which one number is hostile."""
    frames, made = make_frames(SCENES), {}
    image, y, x = (int(i) for i in frames.masks.nonzero()[3])
    places = {
        "images": (frames, (image, 1, y, x)),
        "origin": (frames, (1, 2)),
        "near": (frames.cameras, (1,)),
        "far": (frames.cameras, (1,)),
        "Ks": (frames.cameras, (1, 0, 0)),
        "viewmats": (frames.cameras, (1, 2, 3)),
    }
    for name, (owner, place) in places.items():
        for number in NUMBERS:
            value = getattr(owner, name).clone()
            value[place] = number
            changed = dataclasses.replace(owner, **{name: value})
            made[f"{name} {number}"] = changed if owner is frames else dataclasses.replace(frames, cameras=changed)
    return made


@pytest.mark.parametrize("on_invalid", POLICIES)
def test_every_policy_on_invalid_frames(on_invalid, simulator):
    refused = set()
    for name, frames in hostile_frames().items():
        if check(simulator, encoded_and_simulated(simulator, frames, on_invalid)):
            refused.add(name)
    assert {"origin nan", "origin 1e+19", "near 0.0", "near 1e-38", "far inf", "Ks 0.0", "viewmats 1e+30"} <= refused
    assert {"origin 10000.0", "Ks 10000.0"}.isdisjoint(refused)
    assert ("images nan" in refused) == ("images 1e+30" in refused) == (on_invalid == "raise")


@pytest.mark.parametrize("on_invalid", POLICIES)
@pytest.mark.parametrize("field", ["means", "opacities", "dynamic_latents", "static_latents", "origin"])
def test_every_policy_on_invalid_particles(field, on_invalid, simulator):
    with torch.no_grad():
        state = simulator.encode(make_frames(SCENES))
    for number in NUMBERS:

        def call(report, number=number):
            leaf = getattr(state, field).clone()
            leaf.view(-1)[5] = number
            leaf.requires_grad_(field != "origin")
            options = {"on_invalid": on_invalid, "report": report}
            steps = simulator.rollout(dataclasses.replace(state, **{field: leaf}), 2, **options)
            images = simulator.render(steps[-1], target_cameras(make_frames(SCENES), 2), **options)
            return [steps[-1].means, images.color], [leaf] if leaf.requires_grad else []

        assert check(simulator, call) or number == number or on_invalid != "raise"


def overflows(x):
    return (x * 1e30) ** 3


def divides(x):
    return x / (x - x)


def has_no_root(x):
    return (-x.abs()).sqrt() + x


@pytest.mark.parametrize("on_invalid", ["drop", "clamp"])
@pytest.mark.parametrize("spoil", [overflows, divides, has_no_root])
@pytest.mark.parametrize("call", ["rollout", "render"])
def test_gradients_of_overflowed_values_raise(call, spoil, on_invalid, simulator):
    """Forward such rows are dropped or bounded; what made them has no gradient, and says so."""
    with torch.no_grad():
        state = simulator.encode(make_frames(SCENES))
    weight = torch.ones(state.n_rows, 1, requires_grad=True)
    means = torch.cat([spoil(weight[:4]) * state.means[:4], (weight * state.means)[4:]])
    spoiled, report = dataclasses.replace(state, means=means), StabilityReport()
    if call == "rollout":
        out = simulator.rollout(spoiled, 1, on_invalid=on_invalid, report=report)[-1].means
    else:
        cameras = target_cameras(make_frames(SCENES), 1)
        out = simulator.render(spoiled, cameras, on_invalid=on_invalid, report=report).color
    assert bool(out.isfinite().all())
    with pytest.raises(NumericalError, match=f"{call}: particles.means: not finite at row 0 .*gradients behind it"):
        torch.autograd.grad(out.square().sum(), weight, retain_graph=True)
    report.close()  # as training does, which looks at all gradients itself
    torch.autograd.grad(out.square().sum(), weight)


def test_autograd_graph_is_hooked_once(simulator):
    with torch.no_grad():
        state = simulator.encode(make_frames(SCENES))
    leaf = state.means.clone().requires_grad_()
    means = leaf * 2
    bad = torch.where(torch.arange(len(means))[:, None] == 1, NAN, means)
    for _ in range(2):
        validate_particles(dataclasses.replace(state, means=bad), StabilityConfig("drop"), StabilityReport(), "here")
    assert "gsim3d.validated" in means.grad_fn.metadata
    (grad,) = torch.autograd.grad(bad[2:].sum(), leaf)
    assert bool(grad.isfinite().all())
