"""Readers of recorded scenes, splits, and windows with drawn views."""

from gsim3d.data.dataset import (
    Window,
    WindowSampler,
    generator,
    make_frames,
    split_scenes,
    window_frames,
)
from gsim3d.data.genesis import Scene, find_scenes

__all__ = [
    "Scene",
    "Window",
    "WindowSampler",
    "find_scenes",
    "generator",
    "make_frames",
    "split_scenes",
    "window_frames",
]
