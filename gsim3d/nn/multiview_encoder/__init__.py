"""Images of calibrated cameras -> particles: multi-view features, cost volume, depth, view-independent latents."""

from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.nn.multiview_encoder.encoder import Encoder, pixel_rows
from gsim3d.nn.multiview_encoder.static_shapes import StaticShapes

__all__ = ["Encoder", "EncoderConfig", "StaticShapes", "pixel_rows"]
