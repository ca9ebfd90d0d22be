"""Physics scenes filmed by many cameras: data to train and test a simulator on (MuJoCo moves, Embree draws)."""

from gsim3d.generate.run import Report, generate
from gsim3d.generate.worlds import PRESETS, WORLDS

__all__ = ["PRESETS", "WORLDS", "Report", "generate"]
