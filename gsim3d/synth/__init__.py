"""Synthetic data: multi-view videos of physics scenes, simulated by MuJoCo and ray-traced by Embree."""

from gsim3d.synth.run import Report, generate
from gsim3d.synth.worlds import HELD_OUT, PRESETS, WORLDS

__all__ = ["HELD_OUT", "PRESETS", "WORLDS", "Report", "generate"]
