"""Physics scenes seen by many cameras: data to train and test a simulator on (MuJoCo moves, Embree draws)."""

from gsim3d.synth.run import Report, generate
from gsim3d.synth.worlds import HELD_OUT, PRESETS, WORLDS

__all__ = ["HELD_OUT", "PRESETS", "WORLDS", "Report", "generate"]
