"""Where the rows of a call meet a background that was computed before: whose scene, which cell, which patch."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsim3d.ops._arguments import check_numbers, check_tensors, check_whole
from gsim3d.ops._register import fakes, register_autocast, register_gradients
from gsim3d.ops.curve import PatchTable, Segments

RUN = 64  # rows that are summed one after another


def row_scenes(cloud_scene: Tensor, cu_input: Tensor, stages: Sequence[Segments]) -> list[Tensor]:
    """The scene of every row of every stage: that of the first row that it pools.

    Args:
        cloud_scene: int64 [Q], of the clouds of the input.
        cu_input: int64 [Q + 1], input rows of each cloud.
        stages: at most 8; the rows of the stage before, first of the input, that each row pools.
    Returns:
        int64 [M] for each stage; 0 for rows that pool none.
    Gradients:
        none, since results are integers.
    Raises:
        ValueError, TypeError: a shape, a dtype or a device does not fit; the message names the argument.

    Example:
        >>> one_by_one = Segments(torch.arange(4), torch.arange(5))
        >>> halves = Segments(torch.tensor([2, 3, 0, 1]), torch.tensor([0, 2, 4]))
        >>> row_scenes(torch.tensor([5, 7]), torch.tensor([0, 3, 4]), [one_by_one, halves])
        [tensor([5, 5, 5, 7]), tensor([5, 5])]
    """
    lists = {f"stages[{s}].{name}": getattr(x, name) for s, x in enumerate(stages) for name in ("rows", "cu_rows")}
    check_tensors("row_scenes", cloud_scene=cloud_scene, cu_input=cu_input, **lists)
    return torch.ops.gsim3d.row_scenes(cloud_scene, cu_input, [x.rows for x in stages], [x.cu_rows for x in stages])


def find_cells(cells: Tensor, scene: Tensor, grid: Tensor) -> Tensor:
    """The place of each row's cell in a sorted list of cells.

    Args:
        cells: int64 [D], D at least 1, ascending: ``scene << 48 | x << 32 | y << 16 | z``. The last one is nowhere.
        scene: int64 [N].
        grid: int64 [N, 3], in [0, 2^16).
    Returns:
        int64 [N], D - 1 for rows whose cell is not in the list.
    Gradients:
        none, since results are integers.
    Raises:
        ValueError, TypeError: a shape, a dtype or a device does not fit; the message names the argument.

    Example:
        >>> cells = torch.tensor([(2 << 32) + 1, 1 << 48, torch.iinfo(torch.int64).max])
        >>> find_cells(cells, torch.tensor([0, 1, 1]), torch.tensor([[2, 0, 1], [0, 0, 0], [2, 0, 1]]))
        tensor([0, 1, 2])
    """
    check_tensors("find_cells", cells=cells, scene=scene, grid=grid)
    return torch.ops.gsim3d.find_cells(cells, scene, grid)


def add_cells(x: Tensor, field: Tensor, places: Tensor, *, check: bool = True) -> Tensor:
    """``x[i] + field[places[i]]``: what rows read of the cells that they lie in.

    Args:
        x: [N, C], float32 or float64, on CUDA also float16 and bfloat16. Under ``torch.autocast`` CUDA computes in its
            dtype and the CPU in float32.
        field: [D, C], dtype of ``x``.
        places: int64 [N] in [0, D), as of :func:`find_cells`. On CUDA a row with another one is copied.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [N, C], dtype of ``x``.
    Gradients:
        ``x`` and ``field``, once; sums over the rows of a cell have one order.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it.

    Example:
        >>> add_cells(torch.ones(2, 1), torch.tensor([[5.0], [7.0]]), torch.tensor([1, 0])).flatten()
        tensor([8., 6.])
    """
    if check:
        check_tensors("add_cells", x=x, field=field, places=places)
        check_numbers("add_cells", x=x, field=field)
    return torch.ops.gsim3d.add_cells(x, field, places)


def overlapping_patches(
    first: Tensor, kv_rows: Tensor, cu_k: Tensor, codes: Tensor, order: Tensor, cu_clouds: Tensor, *, patch_size: int
) -> tuple[PatchTable, ...]:
    """Attention of rows to patches that others were cut into: each asks the patch in whose interval of the curve it
    lies.

    A patch of more than ``patch_size`` queries becomes several, which list the same keys: blocks of a GPU share
    patches. Sizes follow from those of the arguments; the last patches are empty.

    Args:
        first: int64 [R, P], ascending along each of R curves: the code at which a patch begins, ``scene << 48 | code``.
            A scene's first patch begins at ``scene << 48``.
        kv_rows: int64 [R, M], keys; patch p has those from cu_k[p] to cu_k[p + 1] of each curve.
        cu_k: int64 [P + 1], steps of at most ``patch_size``.
        codes: int64 [R, N] of the rows, scenes above.
        order: int64 [R, N], the rows cloud by cloud, by ascending code in each.
        cu_clouds: int64 [C + 1], where clouds begin in ``order``; entries behind the last cloud are no rows.
        patch_size: at least 1.
    Returns:
        One table a curve, of P + N // patch_size patches. A row of a scene without patches is in none.
    Gradients:
        none, since results are integers.
    Raises:
        ValueError, TypeError: a shape, a dtype, a device or, on the CPU, an entry does not fit; the message names the
            argument.

    Example:
        >>> first, kv_rows, cu_k = torch.tensor([[0, 8]]), torch.tensor([[0, 1, 2]]), torch.tensor([0, 2, 3])
        >>> codes, order = torch.tensor([[9, 3, 4]]), torch.tensor([[1, 2, 0]])
        >>> table = overlapping_patches(first, kv_rows, cu_k, codes, order, torch.tensor([0, 3]), patch_size=2)[0]
        >>> table.q_rows, table.cu_q, table.kv_rows[:3], table.cu_k
        (tensor([1, 2, 0]), tensor([0, 2, 3, 3]), tensor([0, 1, 2]), tensor([0, 2, 3, 3]))
    """
    names = ("first", "kv_rows", "cu_k", "codes", "order", "cu_clouds")
    tensors = (first, kv_rows, cu_k, codes, order, cu_clouds)
    check_tensors("overlapping_patches", **dict(zip(names, tensors, strict=True)))
    check_whole("overlapping_patches", patch_size=patch_size)
    tables = torch.ops.gsim3d.overlapping_patches(*tensors, patch_size)
    return tuple(PatchTable(*lists) for lists in zip(*(table.unbind() for table in tables), strict=True))


def _patches(first, kv_rows, cu_k, codes, order, cu_clouds, patch_size):
    curves, n_parts = first.shape[0], first.shape[1] + codes.shape[1] // patch_size
    sizes = (codes.shape[1], kv_rows.shape[1] + codes.shape[1], n_parts + 1, n_parts + 1)
    return tuple(first.new_empty(curves, size) for size in sizes)


fakes(
    row_scenes=lambda cloud_scene, cu_input, rows, cu_rows: [cloud_scene.new_empty(cu.shape[0] - 1) for cu in cu_rows],
    find_cells=lambda cells, scene, grid: cells.new_empty(scene.shape),
    add_cells=lambda x, field, places: x.new_empty(x.shape),
    overlapping_patches=_patches,
)


def _setup(ctx, inputs, output):
    _, field, places = inputs
    ctx.save_for_backward(places)
    ctx.n_cells = field.shape[0]


def _backward(ctx, grad):
    (places,) = ctx.saved_tensors
    return grad, _sum_by_cell(grad, places, ctx.n_cells) if ctx.needs_input_grad[1] else None, None


def _sum_by_cell(x: Tensor, places: Tensor, n_cells: int) -> Tensor:
    """[n_cells, C], in one order and without atomics: a cell that has most rows is summed in runs, then over them."""
    found, rows = places.sort(stable=True)
    cu_cells = torch.searchsorted(found, torch.arange(n_cells + 1, device=places.device))
    cuts = torch.cat([cu_cells, torch.arange(0, places.shape[0], RUN, device=places.device)]).sort().values
    runs = torch.ops.gsim3d.unpool_backward(x.to(torch.promote_types(x.dtype, torch.float32)), rows, cuts)
    each = torch.arange(runs.shape[0], device=places.device)
    return torch.ops.gsim3d.unpool_backward(runs, each, torch.searchsorted(cuts, cu_cells)).to(x.dtype)


register_gradients("add_cells", _backward, _setup)
register_autocast("add_cells", "follow")
