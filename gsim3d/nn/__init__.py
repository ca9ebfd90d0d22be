"""Networks: multi-view encoder, Point Transformer, Gaussian head and their layers."""

from gsim3d.nn.point_transformer_v3 import PointTransformerV3, PointTransformerV3Config

__all__ = ["PointTransformerV3", "PointTransformerV3Config"]
