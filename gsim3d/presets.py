"""Presets of model sizes: functions that return a ModelConfig."""

from dataclasses import dataclass, field

from gsim3d.dynamics import DynamicsConfig
from gsim3d.nn.gaussian_head import RendererConfig
from gsim3d.nn.multiview_encoder import EncoderConfig
from gsim3d.numerics.policy import StabilityConfig


@dataclass(frozen=True)
class ModelConfig:
    """Configuration of a simulator; its parts must agree on the attributes of particles.

    Attributes:
        encoder: images to particles.
        dynamics: particles to particles of the next step.
        renderer: particles to Gaussians.
        stability: numerical limits and policy.
    """

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    renderer: RendererConfig = field(default_factory=RendererConfig)
    stability: StabilityConfig = field(default_factory=StabilityConfig)

    def __post_init__(self):
        encoder, dynamics, renderer = self.encoder, self.dynamics, self.renderer
        latents = encoder.dynamic_dim + encoder.static_dim
        sh_degrees = (encoder.sh_degree, dynamics.sh_degree, renderer.sh_degree)
        agreements = {
            "encoder.dynamic_dim and dynamics.dynamic_latents": (encoder.dynamic_dim, dynamics.dynamic_latents),
            "encoder.static_dim and dynamics.static_latents": (encoder.static_dim, dynamics.static_latents),
            "encoder.explicit and dynamics.explicit": (encoder.explicit, dynamics.explicit),
            "renderer.latents and what it reads": (renderer.latents, 0 if encoder.explicit else latents),
            "the three sh_degree": sh_degrees if encoder.explicit else (0,),
        }
        for what, values in agreements.items():
            if len(set(values)) > 1:
                raise ValueError(f"ModelConfig: {what} must be equal; got {', '.join(map(str, values))}")


def tiny() -> ModelConfig:
    """Smallest model, trains on two CPU cores in minutes: 64-pixel images, scenes of about 1 m, history up to 2."""
    encoder = EncoderConfig.tiny()
    dynamics = DynamicsConfig(
        dynamic_latents=encoder.dynamic_dim, static_latents=encoder.static_dim, max_step=0.5, max_latent_step=1.0,
        position_features=True, grid_size=0.05, history_bits=1, strides=(2, 4), merge_windows=(2, 1),
        patch_sizes=(256, 256, 256), encoder_depths=(1, 1, 1), encoder_channels=(24, 32, 48), encoder_heads=(3, 4, 6),
        decoder_depths=(1, 1), decoder_channels=(24, 32), decoder_heads=(3, 4), mlp_ratio=2, norm="layer",
        zero_init=True, drop_path=0.0, shuffle_orders=False,
    )  # fmt: skip
    latents = encoder.dynamic_dim + encoder.static_dim
    renderer = RendererConfig(latents=latents, sh_degree=0, scale_min=0.002, scale_max=0.08, initial_scale=0.02)
    return ModelConfig(encoder, dynamics, renderer)


def small() -> ModelConfig:
    """Model of about 4 million parameters, trains in a day on one GPU: 128-pixel images, history up to 4."""
    encoder = EncoderConfig(
        feature_dim=64, cnn_dims=(32, 48, 64), transformer_layers=4, transformer_mlp_ratio=2, cost_unet_dim=32,
        refine_unet_dim=32, upsampled_dim=32, disparity_dim=32, dynamic_dim=32, static_dim=32,
    )  # fmt: skip
    dynamics = DynamicsConfig(
        dynamic_latents=encoder.dynamic_dim, static_latents=encoder.static_dim, max_latent_step=1.0,
        position_features=True, grid_size=0.02, history_bits=2, strides=(2, 2, 2), merge_windows=(2, 2, 1),
        patch_sizes=(512,) * 4, encoder_depths=(2, 2, 2, 2), encoder_channels=(32, 48, 64, 128),
        encoder_heads=(2, 3, 4, 8), decoder_depths=(1, 1, 1), decoder_channels=(32, 48, 64), decoder_heads=(2, 3, 4),
        norm="layer", zero_init=True, drop_path=0.1,
    )  # fmt: skip
    renderer = RendererConfig(latents=64, sh_degree=1, scale_min=0.0005, scale_max=0.1, initial_scale=0.01)
    return ModelConfig(encoder, dynamics, renderer)


def paper_latent(n_steps: int = 4, latents: int = 32) -> ModelConfig:
    """The latent model of the paper.

    Args:
        n_steps: history, 1, 2, 4 or 8.
        latents: number of dynamic latents, and of static latents; 32 in the paper, 64 in the published settings.
    """
    encoder = EncoderConfig(dynamic_dim=latents, static_dim=latents)
    dynamics = DynamicsConfig(dynamic_latents=latents, static_latents=latents, history_bits=_bits(n_steps))
    return ModelConfig(encoder, dynamics, RendererConfig(latents=2 * latents))


def paper_explicit(n_steps: int = 4, static_latents: int = 16) -> ModelConfig:
    """The explicit model of the paper, which predicts all Gaussian parameters.

    Args:
        n_steps: history, 1, 2, 4 or 8.
        static_latents: number of static latents; 16 in the paper, 0 in the published settings.
    """
    scales = {"scale_min": 0.004, "scale_max": 0.14}
    sizes = {"static_latents": static_latents, "max_step": 0.05, "history_bits": _bits(n_steps)}
    encoder = EncoderConfig(dynamic_dim=0, static_dim=static_latents, explicit=True)
    dynamics = DynamicsConfig(dynamic_latents=0, explicit=True, **sizes, **scales)
    return ModelConfig(encoder, dynamics, RendererConfig(latents=0, **scales))


def _bits(n_steps: int) -> int:
    if n_steps not in (1, 2, 4, 8):
        raise ValueError(f"n_steps must be 1, 2, 4 or 8; got {n_steps}")
    return n_steps.bit_length() - 1
