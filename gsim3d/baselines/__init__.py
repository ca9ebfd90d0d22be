"""Other systems for physics from video, fitted or trained here and scored in the same harness."""

from gsim3d.baselines.spring_gaus import BASELINES, SpringGausConfig, baseline

__all__ = ["BASELINES", "SpringGausConfig", "baseline"]
