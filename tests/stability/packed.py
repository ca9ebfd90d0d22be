"""A hard scene of the rasterizer beside an ordinary one in the same call."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tests.ops.raster_scene import Scene, facing, gradients
from tests.stability.setting import Measured, Setting

ROWS = Scene.NAMES[:6]  # the inputs that have one row a Gaussian


@dataclass(frozen=True)
class Result:
    """Of the hard scene: color, alpha, depth, features [1, H, W, .] and the gradients by name."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    features: Tensor
    grads: dict[str, Tensor]


def ordinary(like: Scene) -> Scene:
    """A scene of six Gaussians with the image size, colours and features of ``like``."""
    g = torch.Generator().manual_seed(3)
    means = torch.rand(6, 3, generator=g) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
    scene = facing(means, scales=0.08, opacities=0.7, width=like.width, height=like.height, focal=float(like.width))
    color = 0.3 * torch.rand(6, *like.color.shape[1:], generator=g)
    features = torch.rand(6, like.features.shape[1], generator=g)
    return scene.replace(color=color, features=features).to(like.means.dtype)


def pack(scenes: list[Scene]) -> Scene:
    """Scenes of one cloud and one image each in one call."""
    names = (*Scene.NAMES, "Ks")
    counts = torch.tensor([0, *(len(scene.means) for scene in scenes)])
    return scenes[0].replace(
        **{name: torch.cat([getattr(scene, name) for scene in scenes]) for name in names},
        image_cloud=torch.arange(len(scenes)),
        cu_rows=counts.cumsum(0),
    )


def render_beside_another(setting: Setting, measured: Measured, hard: Scene, **options) -> Result:
    """Renders ``hard`` (float32, one cloud, one image) and an ordinary scene together. ``options``: of the op.

    All outputs and gradients must be finite, and those of the ordinary scene must have the bits that they have alone.
    """
    hard = hard.to(setting.dtype)
    mate, n = ordinary(hard), len(hard.means)
    both, alone = setting.to(pack([hard, mate])), setting.to(mate)
    out, grads = both.render(**options), gradients(both.render, both, **options)
    measured.finite(*out, *grads)
    jacobian = {"jacobian": options.get("jacobian", "exact")}
    for a, e in zip(out, alone.render(**jacobian), strict=True):
        measured.same_bits(a[1:], e, "image of the other scene")
    second = [x[1:] for x in both.cotangents()]
    leaves = [x.detach().clone().requires_grad_() for x in alone.inputs]
    expected = torch.autograd.grad(alone.render(*leaves, **jacobian), leaves, second)
    for name, a, e in zip(Scene.NAMES, grads, expected, strict=True):
        measured.same_bits(a[n:] if name in ROWS else a[1:], e, f"gradient of the other scene's {name}")
    own = {name: g[:n] if name in ROWS else g[:1] for name, g in zip(Scene.NAMES, grads, strict=True)}
    return Result(*(x[:1] for x in out), own)


def check_against_oracle(
    setting: Setting,
    measured: Measured,
    hard: Scene,
    *,
    bounds: tuple[str, str] = ("raster", "raster_grad"),
    jacobian: str = "exact",
) -> Result:
    """:func:`render_beside_another`, and the hard scene's outputs and gradients against the float64 oracle.

    bounds: names in tests/tolerances.py, without the precision, of the largest errors of outputs and gradients.
    """
    of_output, of_gradient = (f"{name}_{setting.exact}" for name in bounds)
    result = render_beside_another(setting, measured, hard, jacobian=jacobian)
    hard = hard.to(setting.dtype)
    cotangents = [x[:1].double() for x in pack([hard, ordinary(hard)]).cotangents()]
    exact = hard.to(torch.float64)
    leaves = [x.detach().clone().requires_grad_() for x in exact.inputs]
    outputs = exact.render_oracle(*leaves, jacobian=jacobian)
    for name, expected in zip(("color", "alpha", "depth", "features"), outputs, strict=True):
        measured.close(getattr(result, name), expected, of_output, name)
    sum((x * c).sum() for x, c in zip((*outputs, *leaves), (*cotangents, *[0] * len(leaves)))).backward()
    grads = {name: leaf.grad for name, leaf in zip(Scene.NAMES, leaves, strict=True)}
    # Turning a round Gaussian changes nothing: what is left of its gradient is rounding, of numbers of this size.
    turning = (exact.scales * grads["scales"]).abs().amax().item() if len(exact.scales) else 0
    for name, expected in grads.items():
        what, floor = f"gradient of {name}", turning if name == "quats" else 0.0
        measured.close(result.grads[name], expected, of_gradient, what, floor=floor)
    return result


def without_rows(scene: Scene, rows: list[int]) -> Scene:
    """A scene of one cloud without some of its Gaussians."""
    kept = [i for i in range(len(scene.means)) if i not in rows]
    fields = {name: getattr(scene, name)[kept] for name in ROWS}
    return scene.replace(**fields, cu_rows=torch.tensor([0, len(kept)]))


def check_left_out(setting: Setting, measured: Measured, hard: Scene, rows: list[int], **options) -> Result:
    """``rows`` of ``hard`` have no gradient, and all else is bit-equal to the scene without them."""
    result = render_beside_another(setting, measured, hard, **options)
    rest = check_against_oracle(setting, measured, without_rows(hard, rows))
    for name in ("color", "alpha", "depth", "features"):
        measured.same_bits(getattr(result, name), getattr(rest, name), name)
    kept = [i for i in range(len(hard.means)) if i not in rows]
    for name in ROWS:
        assert not result.grads[name][rows].any(), f"gradient of {name}"
        measured.same_bits(result.grads[name][kept], rest.grads[name], f"gradient of {name}")
    measured.outcome("culled, no gradient")
    return result
