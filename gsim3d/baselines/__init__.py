"""Other systems for physics from video, fitted or trained here and scored in the same harness."""

from gsim3d.baselines.spring_gaus import BASELINES, SpringGaus, SpringGausConfig, baseline
from gsim3d.baselines.spring_mass import Springs, SpringState, advance_frame, bind, build_springs

__all__ = [
    "BASELINES",
    "SpringGaus",
    "SpringGausConfig",
    "SpringState",
    "Springs",
    "advance_frame",
    "baseline",
    "bind",
    "build_springs",
]
