"""The code of the pages for users of other projects runs as printed, with the names that are theirs."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_runs_as_printed(page):
    names = names_of_the_user()
    if page.stem == "from_diff_gaussian_rasterization":  # after the activations, as there
        names["scales"], names["opacities"] = names["scales"].exp(), names["opacities"].sigmoid()[:, None]
    code = "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
    exec(compile(code, page.name, "exec"), names)
    if page.stem == "from_diff_gaussian_rasterization":
        assert names["image"].shape == (3, 30, 40) and names["radii"].shape == (20, 2)
    if page.stem == "from_gsplat":
        assert names["means"].grad.abs().max() > 0
    if page.stem == "from_torch_scatter":
        x, index = names["x"], names["index"]
        of_rows = [x[index == i].logsumexp(0) for i in index]
        torch.testing.assert_close(names["weights"], (x - torch.stack(of_rows)).exp())
