"""``Simulator.rollout(graph="auto")``: rollouts that are captured in a CUDA graph when calls of one kind repeat."""

from __future__ import annotations

from typing import Any

import torch

from gsim3d.cuda_graphs import CapturedRollout, gaps_of, kind_of
from gsim3d.effects.plan import Plan
from gsim3d.errors import CaptureError
from gsim3d.numerics.report import StabilityReport
from gsim3d.state import DYNAMIC, Particles

DEVICES = ("cuda",)  # that have graphs


class RolloutGraphs:
    """The graph of the last kind of rollout of a simulator. A copy of the simulator begins without one.

    A call is of the same kind as the one before if its clouds, fields, plan, number of steps, report, autocast and the
    memory of the weights are equal. The second call in a row captures the rollout, which takes longer than a rollout;
    it and those after it replay the graph. Weights that have changed are read again.

    Attributes:
        obstacle: why the last rollout with ``graph="auto"`` ran step by step; None if it was replayed from a graph.
    """

    def __init__(self) -> None:
        self.obstacle: str | None = None
        self._kind: tuple | None = None
        self._graph: CapturedRollout | CaptureError | None = None
        self._versions: list[int] = []

    def __reduce__(self) -> tuple:
        return RolloutGraphs, ()

    def replayed(
        self, simulator: Any, state: Particles, n_steps: int, plan: Plan, report: StabilityReport, given: dict[str, Any]
    ) -> list[Particles] | None:
        """Returns the steps from a graph, or None where the rollout has to run step by step.

        Args:
            simulator, state, n_steps, plan, report: of the rollout.
            given: other arguments of the rollout, none of which a graph supports.
        """
        self.obstacle = _obstacle(simulator, state, n_steps, plan, given)
        if self.obstacle is not None:
            return None
        weights = [*simulator.parameters(), *simulator.buffers()]
        kind = (simulator, report, n_steps, plan, [x.data_ptr() for x in weights], _kind_of(simulator, state, plan))
        versions = [0 if x.is_inference() else x._version for x in weights]
        if kind != self._kind:
            self._kind, self._graph, self._versions = kind, None, versions
            self.obstacle = "it was the first call of its kind; the next one is captured"
            return None
        try:
            if self._graph is None:
                self._graph = CapturedRollout(simulator, state, n_steps, plan, report=report)
            if isinstance(self._graph, CaptureError):
                raise self._graph
            if versions != self._versions:
                self._graph.reload()
            self._versions = versions
            return self._graph(state).steps
        except CaptureError as error:
            self._graph, self.obstacle = error.with_traceback(None), str(error)
            return None


def _obstacle(simulator: Any, state: Particles, n_steps: int, plan: Plan, given: dict[str, Any]) -> str | None:
    """Returns why a rollout cannot be captured; None if it can."""
    device = state.means.device.type
    if device not in DEVICES:
        return f"graphs need a GPU; the state is on the {device.upper()}"
    if simulator.training or torch.is_grad_enabled():
        return "graphs have no gradients; call simulator.eval() and use torch.no_grad()"
    if device == "cuda" and torch.cuda.is_current_stream_capturing():
        return "another graph is being captured"
    for name, value in given.items():
        if value is not None and value != ():
            return f"a graph does not support {name}"
    if plan.spec.dynamics.sleep is not None:
        return "a graph does not support dynamics.sleep of the plan"
    if n_steps < 1:
        return "there are no steps"
    if simulator.config.dynamics.is_asymmetric and not bool((state.activity == DYNAMIC).any()):
        return "no particle moves"
    return None


def _kind_of(simulator: Any, state: Particles, plan: Plan) -> tuple:
    """Returns what a graph fixes of a state and of the surroundings of a call."""
    table, device = state.clouds, state.means.device
    moving: list[int] = []
    if simulator.config.dynamics.is_asymmetric or plan.spec.dynamics.background == "masked_out":
        clouds = zip(table.starts, table.starts[1:])
        moving = torch.stack([(state.activity[a:b] == DYNAMIC).sum() for a, b in clouds]).tolist()
    return (
        (table.starts, table.scenes, gaps_of(table), moving),
        [(name, value.shape[1:], value.dtype) for name, value in state.row_fields().items()],
        (device, kind_of(state.actions)),
        torch.get_autocast_dtype(device.type) if torch.is_autocast_enabled(device.type) else None,
        torch.is_inference_mode_enabled(),
    )
