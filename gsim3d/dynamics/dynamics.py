"""Particles of the last steps -> particles of the next steps."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.dynamics.clouds import concatenate, newest_clouds
from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.dynamics.point_transformer import PointTransformer
from gsim3d.dynamics.state import StateLayout
from gsim3d.types import Particles


class Dynamics(nn.Module):
    """Predicts how particles change in one step.

    The network reads all steps of a history at once; each row of the newest step gets an increment. Steps are counted
    back from the newest, so one model serves any history of 1 to ``2 ** config.history_bits`` steps. Scenes do not change
    each other (in training with ``norm="batch"`` they do). Rows outside the 2^16 cells from the scene's origin, or not
    finite, sleep: they keep their state and nobody sees them.
    """

    def __init__(self, config: DynamicsConfig):
        super().__init__()
        self.config = config
        self.layout = StateLayout.of(config)
        self.net = PointTransformer(self.layout.in_channels, self.layout.out_channels, config)

    def forward(self, history: Particles, *, generator: torch.Generator | None = None) -> Particles:
        """The next step of every scene, or the next ``config.steps_per_call`` steps.

        Args:
            history: clouds sorted by (scene, step); steps may have different numbers of rows, and gaps are fine.
            generator: of drop path and of the curves' shuffling, both in training only; None: neither happens.
        Returns:
            One cloud a scene and step, each with the rows of the scene's newest step.
        Gradients: features and positions of ``history``, parameters. Cells are constants.
        Raises:
            ValueError: clouds are not sorted, or a history is longer than the model's.
        """
        newest = newest_clouds(history)
        slots, history_bits = self._slots(history, newest)
        curves = self._draw_curves(generator) if self.training and self.config.shuffle_orders else None
        pyramid = ops.build_pyramid(
            history.means,
            history.cu_rows,
            history.cloud_scene,
            slots,
            history.origin,
            self.config.pyramid_spec(history_bits),
            curves=curves,
        )
        features = take_rows(self.layout.pack(history), pyramid.rows)
        features = self.net(features, pyramid, generator=generator if self.training else None)

        state = history.select_clouds(newest)
        is_newest = torch.zeros(history.n_clouds, dtype=torch.bool, device=newest.device).index_fill(0, newest, True)
        awake = is_newest[history.row_cloud()[pyramid.rows]].nonzero()[:, 0]
        row_of_state = torch.cumsum(is_newest[history.row_cloud()], 0) - 1
        prediction, is_awake = self.net.head(take_rows(features, awake)), None
        if awake.shape[0] < state.n_rows:
            rows = row_of_state[pyramid.rows[awake]]
            prediction = put_rows(prediction, rows, state.n_rows)
            is_awake = torch.zeros(state.n_rows, dtype=torch.bool, device=rows.device).index_fill(0, rows, True)
        steps = [
            dataclasses.replace(step, cloud_step=state.cloud_step + 1 + i)
            for i, step in enumerate(self.layout.advance(state, prediction, is_awake))
        ]
        return steps[0] if len(steps) == 1 else concatenate(steps)

    def _slots(self, history: Particles, newest: Tensor) -> tuple[Tensor, int]:
        """Time slot of each cloud, and the bits they are counted in."""
        steps = history.cloud_step
        counts = torch.diff(newest, prepend=newest.new_full((1,), -1))
        first, last = steps[newest - counts + 1], steps[newest]
        longest = int((last - first).max()) + 1 if newest.numel() else 1
        bits = self.config.history_bits
        if longest > 2**bits:
            raise ValueError(f"Dynamics: a history must span at most {2**bits} steps; got {longest}")
        if self.config.quirks.slots_from_first:
            return steps - torch.repeat_interleave(first, counts), (longest - 1).bit_length()
        return 2**bits - 1 - (torch.repeat_interleave(last, counts) - steps), bits

    def _draw_curves(self, generator: torch.Generator | None) -> tuple[tuple[int, ...], ...] | None:
        if generator is None:
            return None
        return tuple(
            tuple(torch.randperm(4, generator=generator, device=generator.device).tolist())
            for _ in range(self.config.n_stages)
        )


def take_rows(x: Tensor, rows: Tensor) -> Tensor:
    """x[rows] for rows that are listed once. (The gradient of indexing uses atomics on CUDA.)"""
    if rows.shape[0] == x.shape[0]:
        return x
    return ops.pool_mean(x, rows, torch.arange(rows.shape[0] + 1, device=rows.device))


def put_rows(x: Tensor, rows: Tensor, n_rows: int) -> Tensor:
    """[n_rows, C] with x at ``rows``, 0 elsewhere."""
    return ops.unpool(x, rows, torch.arange(rows.shape[0] + 1, device=rows.device), n_rows)
