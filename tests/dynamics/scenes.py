"""Small random histories for tests of the dynamics."""

import dataclasses

import torch

from gsim3d.dynamics import Dynamics, DynamicsConfig
from gsim3d.priors import DirectionalLightConfig, InertiaConfig, PositionWavesConfig, ProximityConfig
from gsim3d.state import FROZEN, Particles

TINY = DynamicsConfig(
    dynamic_latents=4,
    static_latents=3,
    max_step=0.3,
    max_latent_step=1.0,
    position_features=True,
    grid_size=0.0625,  # a power of two: whole cells are exact in float32
    history_bits=2,
    strides=(2, 2),
    merge_windows=(2, 2),
    patch_sizes=(16, 16, 16),
    encoder_depths=(1, 1, 1),
    encoder_channels=(8, 12, 16),
    encoder_heads=(2, 3, 2),
    decoder_depths=(1, 1),
    decoder_channels=(8, 12),
    decoder_heads=(2, 3),
    mlp_ratio=2,
    norm="layer",
    drop_path=0.0,
    shuffle_orders=False,
)
SEEING = (
    PositionWavesConfig(count=2),
    ProximityConfig(range=0.1),
    InertiaConfig(radius=0.2),
    DirectionalLightConfig(directions=((0.1, 0.2, 1.0),), shading="occlusion", strength=0.2, unit=0.1, beam=2.0),
)
EXPLICIT = dataclasses.replace(TINY, explicit=True, sh_degree=1, scale_min=0.001, scale_max=0.1)


def make_dynamics(config=TINY, seed=0, dtype=torch.float32):
    torch.manual_seed(seed)
    return Dynamics(config).to(dtype).eval()


def make_history(n_rows=(40, 30), seed=0, config=TINY, frozen_share=0.25, dtype=torch.float32):
    """One scene with n_rows[t] particles at step t, in a box of 0.5 m."""
    g = torch.Generator().manual_seed(seed)
    n, n_steps = sum(n_rows), len(n_rows)

    def rand(*shape):
        return torch.rand(shape, generator=g, dtype=dtype)

    fields = {}
    if config.explicit:
        n_harmonics = (config.sh_degree + 1) ** 2
        fields = {
            "quats": torch.nn.functional.normalize(rand(n, 4) - 0.5, dim=1),
            "scales": 0.01 + 0.05 * rand(n, 3),
            "sh": rand(n, n_harmonics, 3) - 0.5,
        }
    return Particles(
        means=0.25 + 0.5 * rand(n, 3),
        opacities=0.1 + 0.8 * rand(n),
        dynamic_latents=rand(n, config.dynamic_latents) - 0.5,
        static_latents=rand(n, config.static_latents) - 0.5,
        cu_rows=torch.tensor([0, *n_rows]).cumsum(0),
        cloud_scene=torch.zeros(n_steps, dtype=torch.int64),
        cloud_step=torch.arange(n_steps),
        activity=torch.where(rand(n) < frozen_share, FROZEN, 0).to(torch.uint8),
        origin=torch.zeros(1, 3, dtype=torch.float64),
        **fields,
    )


def batch(histories):
    """Packs several scenes into a batch."""
    names = (*Particles.ROW_FIELDS, "cloud_step", "origin")
    names = [name for name in names if getattr(histories[0], name) is not None]
    fields = {name: torch.cat([getattr(h, name) for h in histories]) for name in names}
    counts = torch.cat([torch.diff(h.cu_rows) for h in histories])
    scenes = [h.cloud_scene + i for i, h in enumerate(histories)]
    cu_rows = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    return Particles(**fields, cu_rows=cu_rows, cloud_scene=torch.cat(scenes))


def permute_rows(history, seed=0):
    """Permutes the particles of each cloud. Also returns the permutation."""
    g = torch.Generator().manual_seed(seed)
    pairs = zip(history.cu_rows[:-1].tolist(), history.cu_rows[1:].tolist(), strict=True)
    order = torch.cat([a + torch.randperm(b - a, generator=g) for a, b in pairs])
    names = [name for name in Particles.ROW_FIELDS if getattr(history, name) is not None]
    return dataclasses.replace(history, **{name: getattr(history, name)[order] for name in names}), order


def float_fields(particles):
    names = ("means", "opacities", "dynamic_latents", "static_latents", "quats", "scales", "sh")
    return {name: getattr(particles, name) for name in names if getattr(particles, name) is not None}


def advance(layout, particles, prediction, awake=None):
    """Steps of ``particles`` for a ``prediction`` [N, channels] of a network without priors."""
    outputs, _ = layout.split(prediction, layout.changes())
    return layout.advance(particles, outputs, layout.displacements(particles, outputs), awake)
