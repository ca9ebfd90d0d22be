"""Particles of the last steps -> particles of the next steps."""

from gsim3d.dynamics.background import Background
from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.model import Dynamics
from gsim3d.dynamics.parts import Parts
from gsim3d.dynamics.rollout import rollout, rollout_in_parts
from gsim3d.dynamics.sleep import RestLog, Sleepers
from gsim3d.state import append_step, concatenate, last_steps, with_attribute

__all__ = [
    "Background",
    "Dynamics",
    "DynamicsConfig",
    "Parts",
    "RestLog",
    "Sleepers",
    "append_step",
    "concatenate",
    "last_steps",
    "rollout",
    "rollout_in_parts",
    "with_attribute",
]
