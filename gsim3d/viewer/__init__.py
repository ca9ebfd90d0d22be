"""Predictions to look at: one HTML file that plays them."""

from gsim3d.viewer.player import write_player

__all__ = ["write_player"]
