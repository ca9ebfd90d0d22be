"""Fits 3D Gaussians to an image by gradient descent: rasterization and its gradients, nothing else.

python examples/01_rasterize.py
"""

import torch

from gsim3d import Cameras
from gsim3d.ops import rasterize_gaussians

N, STEPS = 100, 60
torch.manual_seed(0)

# One camera at the origin that looks along z: 64 x 48 pixels, world-to-camera is the identity.
K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
camera = Cameras(torch.eye(4)[None], K, torch.ones(1), torch.full((1,), 9.0), torch.tensor([0]), width=64, height=48)

# The image to fit: an orange disc on blue.
y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
disc = (((x - 32) ** 2 + (y - 24) ** 2) < 150)[..., None]
target = torch.where(disc, torch.tensor([0.9, 0.5, 0.1]), torch.tensor([0.1, 0.2, 0.5]))

means = torch.rand(N, 3) * torch.tensor([3.2, 2.4, 1.0]) - torch.tensor([1.6, 1.2, 0.0]) + torch.tensor([0, 0, 3.0])
quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(N, 1)  # (w, x, y, z)
log_scales, logits, colors = torch.full((N, 3), -1.8), torch.zeros(N), torch.full((N, 3), 0.5)
parameters = [tensor.requires_grad_() for tensor in (means, quats, log_scales, logits, colors)]
optimizer = torch.optim.Adam(parameters, lr=0.03)

for step in range(STEPS):
    image = rasterize_gaussians(means, quats, log_scales.exp(), logits.sigmoid(), camera, colors=colors)
    loss = (image.color[0] - target).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step in (0, STEPS - 1):
        print(f"step {step}: PSNR {-10 * loss.log10():.1f} dB")
