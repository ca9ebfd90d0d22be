"""Particles of the last steps -> particles of the next steps."""

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.frozen_context import FrozenContext
from gsim3d.dynamics.model import Dynamics
from gsim3d.dynamics.partition import Partition
from gsim3d.dynamics.rollout import rollout, rollout_in_parts
from gsim3d.dynamics.sleep import RestLog, Sleepers

__all__ = [
    "FrozenContext",
    "Dynamics",
    "DynamicsConfig",
    "Partition",
    "RestLog",
    "Sleepers",
    "rollout",
    "rollout_in_parts",
]
