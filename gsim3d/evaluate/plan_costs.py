"""Predicted costs of plans: multiply-adds of a simulated step and its images."""

from dataclasses import dataclass

from gsim3d.dynamics import DynamicsConfig
from gsim3d.dynamics.step import StateLayout
from gsim3d.effects.plan import Plan, is_asymmetric
from gsim3d.nn.graph_network import KERNEL
from gsim3d.nn.point_transformer import BLOCK_KERNEL, STEM_KERNEL
from gsim3d.presets import ModelConfig

# Dimension of a surface in a grid: a kernel of K^3 taps has about K^2 neighbours; pooling keeps 1 / stride^2 particles.
SURFACE = 2
SPLATS_A_PIXEL = 30  # Gaussians blended in a pixel
BLENDING, PROJECTION = 12, 250  # multiply-adds of blending, and of projecting, a Gaussian


@dataclass(frozen=True)
class Workload:
    """Sizes of a scene, for cost predictions."""

    moving: int  #: movable particles of a step
    frozen: int  #: frozen particles of a step
    views: int = 1  #: images of a step
    pixels: int = 64 * 64  #: pixels of an image
    actions: int = 0  #: points of actors


def predicted_cost(plan: Plan, model: ModelConfig, work: Workload) -> dict[str, float]:
    """Multiply-adds of one simulated step and its images: "dynamics", "gaussians" (the head) and "images".

    Counts matrix products, attention and splats, for particles on surfaces with the spacing of the grid. Ratios between
    two plans of a model are meaningful; absolute numbers are not.
    """
    background = plan.spec.dynamics.background
    moving = work.moving + (work.frozen if background == "dynamic" else 0)
    frozen = work.frozen if background in ("frozen", "asymmetric") else 0
    context = frozen if is_asymmetric(plan.spec, model) else 0
    drawn = moving + frozen
    frozen_steps = 1 if model.dynamics.is_relightable else plan.history
    acting = work.actions if plan.spec.dynamics.actions else 0
    seen = (moving + acting) * plan.history + (frozen - context) * frozen_steps
    renderer, outputs = model.renderer, plan.spec.outputs
    harmonics = 3 * (plan.sh_degree + 1) ** 2 if outputs.rgb else 0
    hidden = 4 * renderer.latents
    channels = 3 * outputs.rgb + outputs.depth + renderer.latents * outputs.features
    splats = min(drawn, SPLATS_A_PIXEL) * work.pixels
    return {
        "dynamics": _network(model.dynamics, seen, plan.history, context) if moving else 0.0,
        "gaussians": float(drawn * hidden * (renderer.latents + harmonics + 7)),
        "images": float(work.views * (drawn * (PROJECTION + harmonics) + splats * (BLENDING + channels))),
    }


def background_cost(plan: Plan, model: ModelConfig, work: Workload) -> float:
    """Multiply-adds of a background that is computed once a rollout; 0 if each step computes it."""
    return _network(model.dynamics, work.frozen, 1) if is_asymmetric(plan.spec, model) and work.frozen else 0.0


def _network(config: DynamicsConfig, particles: float, history: int, context: float = 0.0) -> float:
    """Multiply-adds of the dynamics network on ``particles`` with a context of ``context`` frozen particles."""
    layout, channels = StateLayout.of(config), config.encoder_channels
    if config.graph is not None:
        return _graph(config, layout.in_channels, layout.out_channels, particles, particles / history)
    merged = config.pyramid_spec((history - 1).bit_length()).merged_bits()
    total = particles * STEM_KERNEL**SURFACE * layout.in_channels * channels[0]
    levels = []
    for s in range(config.n_stages):
        if s > 0:
            total += particles * channels[s - 1] * channels[s]
            fewer = config.strides[s - 1] ** SURFACE
            particles, context = particles / fewer / 2 ** merged[s], context / fewer
        levels.append((particles, context))
        total += config.encoder_depths[s] * _block(config, particles, context, channels[s], config.patch_sizes[s])
    below = channels[-1]
    for s in reversed(range(config.n_stages - 1)):
        width, (particles, context) = config.decoder_channels[s], levels[s]
        total += levels[s + 1][0] * below * width + particles * channels[s] * width
        total += config.decoder_depths[s] * _block(config, particles, context, width, config.patch_sizes[s])
        below = width
    return float(total + particles / history * below * (below + layout.out_channels))


def _graph(config: DynamicsConfig, inputs: int, outputs: int, particles: float, newest: float) -> float:
    """Multiply-adds of a graph network on ``particles``, each a node, of which ``newest`` receive edges."""
    width, layers, neighbours = config.graph.channels, config.graph.layers, KERNEL**SURFACE
    dense = particles * (inputs + (4 + 5 * (1 + layers)) * width) + newest * (width + outputs)
    return float((dense + neighbours * (3 * (particles - newest) + (1 + 2 * layers) * newest) * width) * width)


def _block(config: DynamicsConfig, particles: float, context: float, channels: int, patch: int) -> float:
    """Multiply-adds of a block. A particle attends to its own patch and to one patch of the context."""
    dense = (BLOCK_KERNEL**SURFACE + 1 + 4 + 2 * config.mlp_ratio) * channels**2
    return particles * (dense + 2 * (min(particles, patch) + min(context, patch)) * channels)
