"""The code of the pages for users of other projects runs as printed, with the names that are theirs."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.asserts import assert_close_relative_to_max
from tests.oracle.raster import legendre_basis, rotation_matrix

PAGES = sorted((Path(__file__).parents[2] / "docs" / "compat").glob("from_*.md"))


def names_of_the_user() -> dict:
    """A scene of 20 Gaussians, parameters before their activations, and what trains them."""
    torch.manual_seed(0)
    viewmat, K = torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    viewmat[2, 3] = 4
    shapes = {"means": (20, 3), "quats": (20, 4), "scales": (20, 3), "opacities": (20,), "sh": (20, 16, 3)}
    scene = {name: torch.randn(shape).requires_grad_() for name, shape in shapes.items()}
    cameras = {"viewmats": viewmat[None], "Ks": K[None], "width": 40, "height": 30}
    of_splats = {"world_view": viewmat.T, "K": K, "background": torch.ones(3)}
    strategy = SimpleNamespace(
        step_pre_backward=lambda params, optimizers, state, step, info: info["means2d"].retain_grad(),
        step_post_backward=lambda params, optimizers, state, step, info: info["means2d"].absgrad + 1,
    )
    training = {"params": {}, "optimizers": {}, "state": {}, "step": 0, "strategy": strategy}
    training |= {"loss": torch.nn.functional.l1_loss, "target": torch.zeros(1, 30, 40, 3)}
    return scene | {"colors": scene["sh"]} | cameras | of_splats | training


def run(page: Path, names: dict) -> None:
    """Runs the code of a page with ``names``, and leaves its own there."""
    code = "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
    exec(compile(code, page.name, "exec"), names)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_runs_as_printed(page):
    names = names_of_the_user()
    if page.stem == "from_diff_gaussian_rasterization":  # after the activations, as there
        names["scales"], names["opacities"] = names["scales"].exp(), names["opacities"].sigmoid()[:, None]
    run(page, names)
    if page.stem == "from_diff_gaussian_rasterization":
        assert names["image"].shape == (3, 30, 40) and names["radii"].shape == (20, 2)
    if page.stem == "from_gsplat":
        assert names["means"].grad.abs().max() > 0
    if page.stem == "from_torch_scatter":
        x, index = names["x"], names["index"]
        of_rows = [x[index == i].logsumexp(0) for i in index]
        torch.testing.assert_close(names["weights"], (x - torch.stack(of_rows)).exp())


def image_of_diff_gaussian_rasterization(world_view, projection, tan, size, means, quats, scales, opacities, sh):
    """[3, H, W] on white by the formulas of that project, matrices for row vectors and centres of pixels at integers.

    Its cut at 3 standard deviations is left out.
    """
    seen = torch.cat([means, torch.ones_like(means[:, :1])], 1) @ torch.stack([world_view, projection])
    pixels = ((seen[1, :, :2] / (seen[1, :, 3:] + 1e-7) + 1) * size - 1) / 2
    z, focal = seen[0, :, 2], size / (2 * tan)
    x, y = (torch.clamp(seen[0, :, :2] / z[:, None], -1.3 * tan, 1.3 * tan) * z[:, None]).unbind(1)
    zero = torch.zeros_like(z)
    J = torch.stack([focal[0] / z, zero, -focal[0] * x / z**2, zero, focal[1] / z, -focal[1] * y / z**2], 1)
    half = J.reshape(-1, 2, 3) @ world_view[:3, :3].T @ rotation_matrix(quats) @ torch.diag_embed(scales)
    inverse = torch.linalg.inv(half @ half.mT + 0.3 * torch.eye(2).double())
    directions = torch.nn.functional.normalize(means - torch.linalg.inv(world_view)[3, :3], dim=1)
    colors = (torch.einsum("nk,nkd->nd", legendre_basis(directions, 3), sh) + 0.5).clamp_min(0)
    grid = torch.stack(torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="xy"), -1)
    light, image = torch.ones(grid.shape[:2]), torch.zeros(*grid.shape[:2], 3)
    going = torch.ones(grid.shape[:2], dtype=torch.bool)
    for n in z.argsort():
        d = grid - pixels[n]
        alpha = (opacities[n] * torch.exp(-torch.einsum("hwi,ij,hwj->hw", d, inverse[n], d) / 2)).clamp_max(0.99)
        alpha = torch.where((alpha >= 1 / 255) & (z[n] > 0.2), alpha, 0)
        going = going & (light * (1 - alpha) >= 1e-4)
        image = image + torch.where(going, light * alpha, 0)[..., None] * colors[n]
        light = torch.where(going, light * (1 - alpha), light)
    return (image + light[..., None]).permute(2, 0, 1)


def test_conventions_of_diff_gaussian_rasterization():
    names = {name: x.detach().double() if isinstance(x, torch.Tensor) else x for name, x in names_of_the_user().items()}
    viewmat, size, tan = torch.eye(4).double(), torch.tensor([40, 30]), torch.tensor([0.5, 0.375]).double()
    viewmat[:3, :3] = rotation_matrix(torch.tensor([1, 0.1, -0.2, 0.05]).double())
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 4])
    near, far = 0.01, 100.0
    projection = torch.diag(torch.tensor([1 / tan[0], 1 / tan[1], far / (far - near), 0])).double()
    projection[2, 3], projection[3, 2] = 1, -far * near / (far - near)
    names |= {"scales": 0.1 * names["scales"].exp(), "opacities": names["opacities"].sigmoid()[:, None]}
    names |= {"world_view": viewmat.T, "background": torch.ones(3).double()}
    run(next(page for page in PAGES if page.stem == "from_diff_gaussian_rasterization"), names)
    scene = [names[name] for name in ("means", "quats", "scales", "opacities", "sh")]
    expected = image_of_diff_gaussian_rasterization(viewmat.T, viewmat.T @ projection, tan, size, *scene)
    assert expected.std() > 0.1
    assert_close_relative_to_max(names["image"], expected, 1e-6)  # it adds 1e-7 to what it divides by
