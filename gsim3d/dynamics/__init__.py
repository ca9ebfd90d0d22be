"""Particles of the last steps -> particles of the next steps."""

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.frozen_context import FrozenContext
from gsim3d.dynamics.model import Dynamics
from gsim3d.dynamics.partition import Partition
from gsim3d.dynamics.rollout import rollout, rollout_in_parts
from gsim3d.dynamics.sleep import RestLog, Sleepers
from gsim3d.state import append_step, concatenate, last_steps, with_attribute

__all__ = [
    "FrozenContext",
    "Dynamics",
    "DynamicsConfig",
    "Partition",
    "RestLog",
    "Sleepers",
    "append_step",
    "concatenate",
    "last_steps",
    "rollout",
    "rollout_in_parts",
    "with_attribute",
]
