"""Dataset readers, train/test splits, windows of steps, and packing of images into Frames."""

from gsim3d.data.dataset import Window, generator, published_split, split_scenes
from gsim3d.data.fitting import Fitting
from gsim3d.data.frames import make_frames
from gsim3d.data.layouts import find_scenes
from gsim3d.data.scene import Scene

__all__ = ["Fitting", "Scene", "Window", "find_scenes", "generator", "make_frames", "published_split", "split_scenes"]
