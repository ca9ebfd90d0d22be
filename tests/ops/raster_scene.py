"""Random Gaussians and cameras for the rasterizer's tests."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.cameras import Cameras
from gsim3d.ops import rasterize_gaussians
from tests.oracle import raster as oracle


@dataclass(frozen=True)
class Scene:
    """Inputs of one call; ``inputs`` has gradients, ``color`` is SH [N, K, 3] or colours [N, 3]."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    color: Tensor
    features: Tensor
    background: Tensor
    viewmats: Tensor
    Ks: Tensor
    image_cloud: Tensor
    cu_rows: Tensor
    width: int
    height: int

    NAMES = ("means", "quats", "scales", "opacities", "color", "features", "background", "viewmats")

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        return tuple(getattr(self, name) for name in self.NAMES)

    def to(self, target) -> "Scene":
        """On another device, or floating-point tensors in another dtype."""
        fields = {name: getattr(self, name).to(target) for name in (*self.NAMES, "Ks")}
        if isinstance(target, torch.device):
            fields |= {name: getattr(self, name).to(target) for name in ("image_cloud", "cu_rows")}
        return replace(self, **fields)

    def replace(self, **fields) -> "Scene":
        return replace(self, **fields)

    def cameras(self, viewmats: Tensor | None = None) -> Cameras:
        ones = self.viewmats.new_ones(len(self.viewmats))
        viewmats = self.viewmats if viewmats is None else viewmats
        return Cameras(viewmats, self.Ks, 0.1 * ones, 10 * ones, self.image_cloud, self.width, self.height)

    def render(self, *inputs: Tensor, **options) -> tuple[Tensor, ...]:
        """color, alpha, depth, features of the op; ``inputs`` replace the scene's own."""
        means, quats, scales, opacities, color, features, background, viewmats = inputs or self.inputs
        name = "sh" if color.dim() == 3 else "colors"
        out = rasterize_gaussians(
            means,
            quats,
            scales,
            opacities,
            self.cameras(viewmats),
            features=features,
            background=background,
            cu_rows=self.cu_rows,
            **{name: color},
            **options,
        )
        return tuple(out)

    def render_oracle(self, *inputs: Tensor, **options) -> tuple[Tensor, ...]:
        inputs = inputs or self.inputs
        size = (self.width, self.height)
        return oracle.render(*inputs, self.Ks, self.image_cloud, self.cu_rows, size, **options)

    def cotangents(self, seed: int = 5) -> tuple[Tensor, ...]:
        g = torch.Generator().manual_seed(seed)
        shape = (len(self.viewmats), self.height, self.width)
        shapes = ((*shape, 3), shape, shape, (*shape, self.features.shape[1]))
        return tuple(torch.randn(s, generator=g, dtype=torch.float64).to(self.means) for s in shapes)


def gradients(render, scene: Scene, **options) -> tuple[Tensor, ...]:
    """Gradients of <cotangents, render(inputs)> for all inputs of the scene, in the order of Scene.NAMES."""
    leaves = [x.detach().clone().requires_grad_() for x in scene.inputs]
    return torch.autograd.grad(render(*leaves, **options), leaves, scene.cotangents())


def random_scene(
    n=60, clouds=3, images=4, width=45, height=37, n_features=3, sh_terms=16, seed=0, dtype=torch.float64, spread=0.6
) -> Scene:
    """Gaussians of many shapes around the origin, some outside the images or behind others; cameras with off-centre
    principal points, two focal lengths and a skew; clouds of uneven size, one of them shown by several images."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def uniform(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(images, 1, 1)
    turns = 0.15 * normal(images, 4)
    turns[:, 0] = 1
    viewmats[:, :3, :3] = oracle.rotation_matrix(turns)
    viewmats[:, :3, 3] = torch.tensor([0.0, 0.0, 3.0]) + 0.1 * normal(images, 3)
    K = torch.tensor([[1.3 * width, 2.0, 0.45 * width], [0, 1.1 * width, 0.6 * height], [0, 0, 1]], dtype=torch.float64)
    borders = torch.sort(torch.randint(0, n + 1, (clouds - 1,), generator=g)).values
    return Scene(
        means=spread * normal(n, 3),
        quats=normal(n, 4),
        scales=torch.exp(0.7 * normal(n, 3) - 2.5),
        opacities=0.05 + 0.9 * uniform(n),
        color=0.3 * normal(n, sh_terms, 3) if sh_terms else uniform(n, 3),
        features=normal(n, n_features),
        background=uniform(images, 3),
        viewmats=viewmats,
        Ks=K.repeat(images, 1, 1),
        image_cloud=torch.arange(images) % clouds,
        cu_rows=torch.tensor([0, *borders.tolist(), n]),
        width=width,
        height=height,
    ).to(dtype)


def facing(means, scales=0.1, opacities=0.5, width=16, height=16, focal=16.0, dtype=torch.float32, **fields) -> Scene:
    """Gaussians [N, 3] before one camera at the origin, its axis through the image centre; white, no features."""
    means = torch.as_tensor(means, dtype=dtype).reshape(-1, 3)
    n = len(means)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=dtype)
    scene = Scene(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0], dtype=dtype).repeat(n, 1),
        scales=torch.as_tensor(scales, dtype=dtype).expand(n, 3).clone(),
        opacities=torch.as_tensor(opacities, dtype=dtype).expand(n).clone(),
        color=torch.ones(n, 3, dtype=dtype),
        features=torch.zeros(n, 0, dtype=dtype),
        background=torch.zeros(1, 3, dtype=dtype),
        viewmats=torch.eye(4, dtype=dtype)[None],
        Ks=K[None],
        image_cloud=torch.tensor([0]),
        cu_rows=torch.tensor([0, n]),
        width=width,
        height=height,
    )
    return scene.replace(**fields)
