"""Particles of the last steps -> particles of the next steps."""

from gsim3d.dynamics.clouds import append_step, concatenate, last_steps
from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.dynamics import Dynamics
from gsim3d.dynamics.rollout import rollout

__all__ = ["Dynamics", "DynamicsConfig", "append_step", "concatenate", "last_steps", "rollout"]
