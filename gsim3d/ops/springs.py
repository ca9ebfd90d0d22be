"""Anchors on springs above a ground, over all substeps of a frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsim3d.ops._arguments import check_floating, check_numbers, check_real, check_tensors, check_whole
from gsim3d.ops._register import call, fakes, register_autocast, register_gradients


class SpringLists(NamedTuple):
    """Which springs an anchor feels, and which end at it; of one body, or of several, one behind the other.

    Attributes:
        neighbors: int64 [S], the anchor that each spring pulls its own towards; those of anchor 0 first.
        cu_springs: int64 [N + 1], ascending offsets into the springs, from 0 to S.
        sources: int64 [S], numbers of the springs that end at anchor 0, ascending, then at anchor 1, ...
        cu_sources: int64 [N + 1], ascending offsets into ``sources``.
    """

    neighbors: Tensor
    cu_springs: Tensor
    sources: Tensor
    cu_sources: Tensor

    @staticmethod
    def from_neighbors(neighbors: Tensor, cu_springs: Tensor) -> SpringLists:
        """Returns the lists of springs [S] to ``neighbors``, whose own anchors ``cu_springs`` [N + 1] has."""
        ends, sources = neighbors.sort(stable=True)
        anchors = torch.arange(len(cu_springs), device=neighbors.device)
        return SpringLists(neighbors, cu_springs, sources, torch.searchsorted(ends, anchors))


def advance_springs(
    positions: Tensor,
    velocities: Tensor,
    springs: SpringLists,
    *,
    lengths: Tensor,
    stiffness: Tensor,
    damping: Tensor,
    grip: Tensor,
    external: Tensor,
    seconds: float,
    substeps: int,
    ground: float | None = None,
    power: float = 0.5,
    check: bool = True,
) -> tuple[Tensor, Tensor]:
    """Positions and velocities of anchors of mass 1 after ``substeps`` of semi-implicit Euler.

    A spring of rest length L to a neighbour at distance l along n accelerates its anchor by
    ``(stiffness * (l - L) * (1 + abs(l / L - 1)) ** power + damping * closing) * n``, where ``closing`` is the
    neighbour's relative velocity along n; extensions below 1e-6 m count as 0. An anchor at or below the ground is set
    onto it: its vertical velocity ends, and the horizontal one is scaled by ``grip``, in every substep.

    Args:
        positions: [N, 3] metres, float32 or float64.
        velocities: [N, 3] m/s.
        springs: see :meth:`SpringLists.from_neighbors`; an anchor feels its own alone.
        lengths: [S] metres at rest, positive.
        stiffness: [S] 1/s^2.
        damping: [S] 1/s.
        grip: [N], 1: no friction; 0: sticks.
        external: [N, 3] m/s^2, other accelerations, such as gravity.
        seconds: length of all substeps together.
        substeps: 1 to a million; memory grows with its square root.
        ground: metres, height along z; None: there is none.
        power: of the hardening, at least 0; 0 and 0.5 are fast.
        check: look for numbers that cannot be used, on the CPU.
    Returns:
        positions and velocities [N, 3]; not finite where the substeps are too long for the stiffness.
    Gradients:
        all tensors but the lists, once.
    Determinism:
        every sum has one owner and one order: equal bits for any number of threads.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.
    Source:
        Zhong et al. 2024, "Reconstruction and Simulation of Elastic Objects with Spring-Mass 3D Gaussians".

    Example:
        >>> ends = SpringLists.from_neighbors(torch.tensor([1, 0]), torch.tensor([0, 1, 2]))
        >>> rest = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> of = {"lengths": torch.ones(2), "stiffness": torch.ones(2), "damping": torch.zeros(2)}
        >>> of |= {"grip": torch.ones(2), "external": torch.zeros(2, 3)}
        >>> advance_springs(1.5 * rest, 0 * rest, ends, seconds=0.1, substeps=1, power=0.0, **of)[0][:, 0]
        tensor([0.0050, 1.4950])
    """
    numbers = {"lengths": lengths, "stiffness": stiffness, "damping": damping, "grip": grip, "external": external}
    if check:
        tensors = {"positions": positions, "velocities": velocities, **numbers}
        check_tensors("advance_springs", **tensors, **springs._asdict())
        check_floating("advance_springs", positions=positions)
        if positions.shape != velocities.shape or positions.dtype != velocities.dtype:
            raise ValueError("advance_springs: positions and velocities must have one shape and dtype")
        check_whole("advance_springs", substeps=substeps)
        check_real("advance_springs", seconds=seconds, power=power, **({} if ground is None else {"ground": ground}))
        check_numbers("advance_springs", **tensors)
    height = -math.inf if ground is None else ground
    state = torch.stack([positions, velocities])
    scene = (*springs, *numbers.values(), seconds, substeps, height, power)
    return call("advance_springs", state, *scene)[0].unbind(0)


def _advanced(state, neighbors, *others):
    substeps = others[-3]
    return state.new_empty(state.shape), state.new_empty((substeps - 1) // (math.isqrt(substeps - 1) + 1), *state.shape)


def _gradients(grad, last, kept, state, neighbors, *others):
    shapes = (state.shape, *3 * [neighbors.shape], state.shape[1:2], state.shape[1:])
    return tuple(state.new_empty(shape) for shape in shapes)


def _setup(ctx, inputs, output):
    ctx.save_for_backward(*output, *inputs[:10])
    ctx.mark_non_differentiable(output[1])
    ctx.others = inputs[10:]


def _backward(ctx, grad, _):
    state, *others = call("advance_springs_backward", grad, *ctx.saved_tensors, *ctx.others)
    return state, *4 * [None], *others, *4 * [None]


fakes(advance_springs=_advanced, advance_springs_backward=_gradients)
register_gradients("advance_springs", _backward, _setup, gradient_ops=["advance_springs_backward"])
register_autocast("advance_springs", "float32")
