"""Planners: sequences of actions that minimise a cost under any batched dynamics."""

from gsim3d.planning.planners import CEM, MPPI, GradientDescent, Plan, Planner

__all__ = ["CEM", "MPPI", "GradientDescent", "Plan", "Planner"]
