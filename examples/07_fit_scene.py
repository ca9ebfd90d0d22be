"""Fits a static scene to images: 3D Gaussian splatting with densification (clone, split, prune, reset).

python examples/07_fit_scene.py                                   a small generated scene, seconds on a CPU
python examples/07_fit_scene.py --data points.npz --steps 7000    points with colours (means3d, colors, viewmats)
python examples/07_fit_scene.py --data points.npz --beside gsplat the same with gsplat, on a GPU
"""

import argparse
import math
import time

import numpy as np
import torch

from gsim3d.compat.gsplat import rasterization

parser = argparse.ArgumentParser()
parser.add_argument("--data", help=".npz with means3d [N, 3], colors [N, 3] of 0 to 255 and viewmats [C, 4, 4]")
parser.add_argument("--steps", type=int, default=300, help="of optimisation, one image each")
parser.add_argument("--width", type=int, default=64, help="pixels of an image, 4:3")
parser.add_argument("--cameras", type=int, default=24, help="on a circle; every sixth is held out")
parser.add_argument("--beside", choices=["gsplat"], help="also fit with this package's rasterization")
options = parser.parse_args()
if options.steps < 1 or options.width < 2 or options.cameras < 2:
    parser.error("--steps must be at least 1, --width and --cameras at least 2")
if options.beside:
    from gsplat import rasterization as beside
device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
width, height = options.width, options.width * 3 // 4
RATES = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "colors": 2.5e-3}
QUICK = 10 if options.data is None else 1  # few steps: larger ones, and only few new Gaussians
GROW, SMALL, FAINT = 2e-4 * QUICK, 0.01, 0.005  # gradient that asks for more; size of the scene; opacity


def third_neighbour(points):
    """Distance [N] to the third nearest point, block by block."""
    blocks = [torch.cdist(block, points).topk(4, largest=False).values[:, 3] for block in points.split(512)]
    return torch.cat(blocks).clamp_min(1e-4)[:, None]


def load_points():
    """Points [N, 3], colours [N, 3], which way is up, and the radius of the circle of cameras."""
    if options.data is None:
        angle, turn = torch.rand(2, 1500) * 2 * math.pi
        ring = torch.stack(
            [(1 + 0.4 * turn.cos()) * angle.cos(), 0.4 * turn.sin(), (1 + 0.4 * turn.cos()) * angle.sin()]
        )
        return ring.T, 0.5 + 0.5 * torch.stack([angle.cos(), turn.sin(), (3 * angle).sin()], 1), -torch.eye(3)[1], 3.0
    data = np.load(options.data)
    points, viewmats = torch.tensor(data["means3d"]), torch.tensor(data["viewmats"])
    centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
    radius = (centres - points.median(0).values).norm(dim=1).mean().item()
    return points, torch.tensor(data["colors"]) / 255, -viewmats[:, 1, :3].mean(0), radius


def look_at(middle, up, radius):
    """World-to-camera matrices [C, 4, 4] on a circle, a little above it and looking at the middle."""
    up = torch.nn.functional.normalize(up, dim=0)
    side = torch.linalg.cross(up, torch.tensor([0.3, 0.5, 0.8]))
    side = side / side.norm()
    viewmats = torch.eye(4).repeat(options.cameras, 1, 1)
    for i, angle in enumerate(torch.arange(options.cameras) * 2 * math.pi / options.cameras):
        out = angle.cos() * side + angle.sin() * torch.linalg.cross(up, side) + 0.4 * up
        centre, forward = middle + radius * out / out.norm(), -out / out.norm()
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
        viewmats[i, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmats[i, :3, 3] = -viewmats[i, :3, :3] @ centre
    return viewmats


class Splats:
    """Gaussians being fitted, with Adam's state row by row."""

    def __init__(self, points, extent):
        n = len(points)
        self.extent = extent
        start = {
            "means": points, "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), "colors": torch.zeros(n, 3),
            "scales": third_neighbour(points).log().repeat(1, 3), "opacities": torch.full((n,), -2.0),
        }  # fmt: skip
        self.rows = {name: value.to(device).clone().requires_grad_() for name, value in start.items()}
        self.rates = {name: rate * QUICK * (extent if name == "means" else 1) for name, rate in RATES.items()}
        groups = [{"params": [self.rows[name]], "lr": rate, "name": name} for name, rate in self.rates.items()]
        self.adam = torch.optim.Adam(groups, eps=1e-15)
        self.forget()

    def forget(self):
        self.grown = torch.zeros(2, len(self.rows["means"]), device=device)  # sums of |gradient|, how often seen

    def render(self, call, viewmats, K, **more):
        rows = self.rows
        shapes = (rows["means"], rows["quats"], rows["scales"].exp(), rows["opacities"].sigmoid())
        return call(*shapes, rows["colors"].sigmoid(), viewmats, K, width, height, packed=False, **more)

    def watch(self, meta):
        seen = (meta["radii"][0] > 0).all(-1)
        grad = meta["means2d"].grad[0] * torch.tensor([width / 2, height / 2], device=device)
        self.grown += torch.stack([grad.norm(dim=-1) * seen, seen.float()])

    def keep(self, chosen, fresh):
        """Rows ``chosen`` of before; those that are ``fresh`` start with empty moments."""
        for group in self.adam.param_groups:
            old = group["params"][0]
            new = old.detach()[chosen].requires_grad_()
            state = self.adam.state.pop(old)
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment] = state[moment][chosen]
                state[moment][fresh] = 0
            self.adam.state[new], group["params"], self.rows[group["name"]] = state, [new], new

    @torch.no_grad()
    def densify(self):
        rows = self.rows
        wanted = self.grown[0] / self.grown[1].clamp_min(1) > GROW
        large = rows["scales"].exp().amax(1) > SMALL * self.extent
        clone, split = (wanted & ~large).nonzero()[:, 0], (wanted & large).nonzero()[:, 0]
        n = len(wanted)
        chosen = torch.cat([torch.arange(n, device=device), clone, split])
        self.keep(chosen, torch.arange(len(chosen), device=device) >= n)
        halves = torch.cat([split, torch.arange(n + len(clone), len(chosen), device=device)])
        size = self.rows["scales"][halves].exp()  # of isotropic and nearly isotropic ones: no rotation
        self.rows["means"][halves] += size * torch.randn_like(size)
        self.rows["scales"][halves] -= math.log(1.6)
        kept = (self.rows["opacities"].sigmoid() > FAINT).nonzero()[:, 0]
        self.keep(kept, torch.zeros(len(kept), dtype=torch.bool, device=device))
        self.forget()

    @torch.no_grad()
    def reset(self):
        self.rows["opacities"].clamp_(max=math.log(2 * FAINT))
        for moment in ("exp_avg", "exp_avg_sq"):
            self.adam.state[self.rows["opacities"]][moment].zero_()


def now():
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def fit(name, call, points, extent, viewmats, K, images):
    """Prints PSNR of the held-out images against steps and seconds."""
    torch.manual_seed(1)
    splats, start, passes = Splats(points, extent), now(), 0.0
    held_out = torch.arange(len(images)) % 6 == 0
    seen = (~held_out).nonzero()[:, 0].tolist()
    every = max(10, options.steps // 70)
    for step in range(1, options.steps + 1):
        for group in splats.adam.param_groups:  # decay to a tenth in the last 30 %, after densification
            group["lr"] = splats.rates[group["name"]] * 0.1 ** max(0, step / options.steps / 0.3 - 7 / 3)
        i, began = seen[torch.randint(len(seen), ()).item()], now()
        image, _, meta = splats.render(call, viewmats[i : i + 1], K)
        meta["means2d"].retain_grad()
        loss = (image[0] - images[i]).abs().mean()
        loss.backward()
        passes += now() - began
        splats.watch(meta)
        splats.adam.step()
        splats.adam.zero_grad()
        if step % every == 0 and step < 0.7 * options.steps:
            splats.densify()
        if step % (12 * every) == 0 and step < 0.6 * options.steps:
            splats.reset()
        if step == 1 or step % max(1, options.steps // 6) == 0:
            with torch.no_grad():
                image = splats.render(call, viewmats[held_out], K.expand(int(held_out.sum()), -1, -1))[0]
            psnr = -10 * (image - images[held_out]).square().mean().log10().item()
            n = len(splats.rows["means"])
            print(f"{name}: step {step}, {now() - start:.1f} s, {n} Gaussians, PSNR {psnr:.2f} dB")
    whole = (now() - start) / options.steps
    print(f"{name}: {1e3 * passes / options.steps:.2f} ms forward and backward, {1e3 * whole:.2f} ms a step")


torch.manual_seed(0)
points, colors, up, radius = load_points()
viewmats = look_at(points.median(0).values, up, radius).to(device)
K = torch.tensor([[[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1]]], device=device)
points = points.to(device)
scales = third_neighbour(points).repeat(1, 3)
quats = torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(len(points), 1)
target = (points, quats, scales, torch.full_like(scales[:, 0], 0.9), colors.float().to(device))
with torch.no_grad():
    images = torch.cat([rasterization(*target, viewmat[None], K, width, height)[0] for viewmat in viewmats])
some = points[torch.randperm(len(points))[: len(points) // 4]]
some = some + 0.5 * third_neighbour(some) * torch.randn_like(some)
fit("gsim3d", rasterization, some, radius, viewmats, K, images)
if options.beside:
    fit("gsplat", beside, some, radius, viewmats, K, images)
