"""Space-filling curves, and all geometry of a call of the dynamics network as integers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from gsim3d.errors import check_one_of
from gsim3d.ops import _neighbours as neighbours
from gsim3d.ops._arguments import check_real, check_tensors, check_whole
from gsim3d.ops._register import fakes
from gsim3d.ops.streams import MANY_STREAMS, Streams

CURVES = ("z", "z-trans", "hilbert", "hilbert-trans")
N_COUNTS = 4  # of a stage that are found: rows, clouds, patches, keys


def curve_encode(
    grid: Tensor, cloud: Tensor | None, curve: str | Sequence[str], *, depth: int = 16, shift: int | None = None
) -> Tensor:
    """Codes of cells along a space-filling curve, clouds above them.

    ``code = cloud << shift | curve_code(x, y, z)``, 3 bits a level. The z curve interleaves the bits of x, y, z from
    high to low; "hilbert" is Skilling's curve with x first; "-trans" curves exchange x and y. For all four,
    ``code >> 3`` is the code of ``grid >> 1`` at ``depth - 1``.

    Args:
        grid: int64 [N, 3], cells in [0, 2^depth).
        cloud: int64 [N], in [0, 2^(63 - shift)); None: 0.
        curve: "z", "z-trans", "hilbert" or "hilbert-trans"; or R of them.
        depth: levels of the curve, 1 to 16. Hilbert codes depend on it.
        shift: position of the cloud's lowest bit, 3 depth to 62; default 3 depth.
    Returns:
        int64 [N], or [R, N] for R curves. On CUDA a row whose cell or cloud is out of range has code 0.
    Gradients:
        none, since results are integers.
    Raises:
        ValueError: depth or shift is out of range or, on the CPU, a cell or a cloud; the message names row and axis.
    Source:
        Morton order; Skilling, "Programming the Hilbert curve" (2004).

    Example:
        >>> curve_encode(torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), None, "z")
        tensor([4, 2, 1])
    """
    check_tensors("curve_encode", grid=grid, **({} if cloud is None else {"cloud": cloud}))
    check_whole("curve_encode", **({} if shift is None else {"shift": shift}))
    _check_depth("curve_encode", depth)
    names = (curve,) if isinstance(curve, str) else curve
    if not isinstance(names, Sequence):
        raise TypeError(f"curve_encode: curve must be a name or several; got {curve!r}")
    for name in names:
        check_one_of("curve_encode: curve", name, CURVES)
    if cloud is None:
        cloud = torch.zeros(grid.shape[:1], dtype=torch.int64, device=grid.device)
    curves = [CURVES.index(name) for name in names]
    codes = torch.ops.gsim3d.curve_encode(grid, cloud, curves, depth, 3 * depth if shift is None else shift)
    return codes[0] if isinstance(curve, str) else codes


def curve_sort(codes: Tensor) -> tuple[Tensor, Tensor]:
    """Stable ascending order of each row of codes, and its inverse.

    ``order[r, i]`` is the index of the i-th smallest code of row r, ``inverse[r, order[r, i]] = i``; equal codes keep
    their order.

    Args:
        codes: int64 [R, N], N below 2^32.
    Returns:
        order, inverse: int64 [R, N]; on CUDA N is below 2^30.
    Gradients:
        none, since results are integers.

    Example:
        >>> curve_sort(torch.tensor([[30, 10, 20]]))
        (tensor([[1, 2, 0]]), tensor([[2, 0, 1]]))
    """
    check_tensors("curve_sort", codes=codes)
    return torch.ops.gsim3d.curve_sort(codes)


@dataclass(frozen=True)
class PyramidSpec:
    """The shape of the dynamics network, as far as geometry depends on it. S levels, S - 1 transitions.

    Attributes:
        grid_size: metres, edge of a cell at level 0.
        slot_bits: time slots of a cloud are in [0, 2^slot_bits).
        strides: per transition, a power of two; cells of the next level are that many cells wide.
        merge_windows: per transition, a power of two; that many neighbouring slots of a scene become one cloud.
        patch_sizes: per level, rows that attend to each other.
        kernel_sizes: per level, odd sizes of the convolutions that run there.
        release: the published model's cells and ties: counted from the minimum over all clouds of the call and
            truncated, curve depth from the extent, equal codes by row. Clouds of one call then change each other.
    """

    grid_size: float
    slot_bits: int
    strides: tuple[int, ...]
    merge_windows: tuple[int, ...]
    patch_sizes: tuple[int, ...]
    kernel_sizes: tuple[tuple[int, ...], ...]
    release: bool = False

    @property
    def n_stages(self) -> int:
        """Levels."""
        return len(self.patch_sizes)

    def merged_bits(self) -> tuple[int, ...]:
        """Slot bits that each stage merges; stage 0 merges none."""
        bits, left = [0], self.slot_bits
        for window in self.merge_windows:
            bits.append(min(window.bit_length() - 1, left))
            left -= bits[-1]
        return tuple(bits)


@dataclass(frozen=True)
class Segments:
    """Segment s holds rows[cu_rows[s]] .. rows[cu_rows[s + 1] - 1].

    Attributes:
        rows: int64 [R].
        cu_rows: int64 [M + 1].
    """

    rows: Tensor
    cu_rows: Tensor


@dataclass(frozen=True)
class Voxels:
    """Rows of equal cloud and cell; V voxels, ordered by (cloud, x, y, z).

    Attributes:
        row_voxel: int64 [N].
        rows: int64 [N], the rows of voxel 0, then of voxel 1, ..., ascending in a voxel.
        cu_rows: int64 [V + 1].
    """

    row_voxel: Tensor
    rows: Tensor
    cu_rows: Tensor


@dataclass(frozen=True)
class KernelMap:
    """Pairs of neighbouring voxels of a convolution, sorted by tap, then by tap_out and tap_in.

    Pairs cu_taps[t] .. cu_taps[t + 1] - 1 belong to tap t = (kx K + ky) K + kz: voxel tap_in lies at the offset
    (kx, ky, kz) - K // 2 cells from voxel tap_out. The centre tap is empty: it reads the row itself.

    Attributes:
        kernel_size: K.
        tap_in: int64 [L].
        tap_out: int64 [L].
        cu_taps: int64 [K^3 + 1].
        plan: int32, what 16-bit convolutions on CUDA derive from the pairs, made once; None: made anew in each.
        shape: taps an axis of the weight; None: K each.
        outputs: int64 [M, 4], batch and cell of the outputs of a convolution with stride; None: outputs are the inputs.
            Voxels are then those of the N inputs and behind them the M outputs, taps are counted around the centre.
        inverted: from the outputs back to the inputs.
    """

    kernel_size: int
    tap_in: Tensor
    tap_out: Tensor
    cu_taps: Tensor
    plan: Tensor | None = None
    shape: tuple[int, int, int] | None = None
    outputs: Tensor | None = None
    inverted: bool = False

    @classmethod
    def from_indices(
        cls,
        indices: Tensor,
        kernel_size: int | tuple[int, int, int] = 3,
        *,
        stride: int | tuple[int, int, int] | None = None,
        padding: int | tuple[int, int, int] = 0,
        dilation: int | tuple[int, int, int] = 1,
        spatial_shape: tuple[int, int, int] | None = None,
    ) -> tuple[Voxels, KernelMap]:
        """The geometry of a convolution over a list of cells, as spconv has it.

        Args:
            indices: int32 or int64 [N, 4], in [0, 2^15): batch, then a cell. Rows may share a cell.
            kernel_size: taps an axis; odd ones where there is no stride.
            stride: None: outputs are the inputs (submanifold). Else, also with 1, outputs are the cells o that a tap
                reaches from an input: ``o stride + tap dilation - padding`` is its cell.
            padding: of a convolution with stride.
            dilation: cells between taps.
            spatial_shape: cells an axis of the inputs, which bound the outputs of a stride; None: o >= 0 alone does.
        Returns:
            voxels and kernel map for :func:`sparse_conv`; with a stride, ``kernel_map.outputs`` are the outputs' cells.
            CUDA waits for their number.
        Raises:
            TypeError, ValueError: an argument is malformed; the message names it.

        Example:
            >>> indices = torch.tensor([[0, 0, 0, 0], [0, 1, 0, 0], [0, 2, 0, 1]])
            >>> voxels, kernel_map = KernelMap.from_indices(indices, 2, stride=2)
            >>> kernel_map.outputs
            tensor([[0, 0, 0, 0],
                    [0, 1, 0, 0]])
        """
        made = neighbours.geometry(indices, kernel_size, stride, padding, dilation, spatial_shape)
        tap_in, tap_out, cu_taps = made.pairs
        own = cls(made.edge, tap_in, tap_out, cu_taps, shape=made.kernel, outputs=made.outputs)
        return Voxels(*made.voxels), own

    def inverse(self) -> KernelMap:
        """The same pairs the other way: from the outputs of a convolution with stride back to its inputs.

        Raises:
            ValueError: it has no stride.
        """
        if self.outputs is None:
            raise ValueError("KernelMap.inverse: only a convolution with stride has an inverse")
        return dataclasses.replace(self, tap_in=self.tap_out, tap_out=self.tap_in, inverted=not self.inverted)


@dataclass(frozen=True)
class PatchTable:
    """Patch p has queries q_rows[cu_q[p]:cu_q[p + 1]] and keys kv_rows[cu_k[p]:cu_k[p + 1]].

    Attributes:
        q_rows: int64 [N]; for :func:`patch_attention` all four may be int32.
        kv_rows: int64 [M].
        cu_q: int64 [P + 1].
        cu_k: int64 [P + 1].
    """

    q_rows: Tensor
    kv_rows: Tensor
    cu_q: Tensor
    cu_k: Tensor


@dataclass(frozen=True)
class Stage:
    """Geometry of the N rows of one level, in C clouds.

    Attributes:
        grid: int64 [N, 3].
        cloud: int64 [N], dense ids ascending by (scene, slot left after merging).
        cu_clouds: int64 [C + 1]; order[:, cu_clouds[c]:cu_clouds[c + 1]] are the rows of cloud c.
        order: int64 [4, N], rows along each serialization, clouds one after another.
        patches: attention patches of each serialization. A cloud is cut from its start; its last patch reads the last
            ``patch_size`` rows of the cloud (all rows where it has fewer).
        voxels: convolution geometry.
        kernel_maps: the same, by kernel size.
        cluster: rows of the level before that each row pools; None at level 0.
        time_index: int64 [N], slot inside the merged window; None where no slots merge.
        n_data: rows that the data has, the first ones; None: not known to the host.
    """

    grid: Tensor
    cloud: Tensor
    cu_clouds: Tensor
    order: Tensor
    patches: tuple[PatchTable, ...]
    voxels: Voxels
    kernel_maps: dict[int, KernelMap]
    cluster: Segments | None
    time_index: Tensor | None
    n_data: int | None = None

    @property
    def n_rows(self) -> int:
        """N."""
        return self.grid.shape[0]

    @property
    def n_clouds(self) -> int:
        """C."""
        return self.cu_clouds.shape[0] - 1


@dataclass(frozen=True)
class Pyramid:
    """All geometry of a call of the dynamics network.

    Attributes:
        rows: int64 [N0], the input rows that take part, ascending.
        cu_rows: int64 [N0 + 1]; row i of level 0 is input row rows[cu_rows[i]].
        stages: the levels, finest first.
        found: of a pyramid of given capacity, or of rounded sizes, int64: 0 where it fits (see
            :meth:`PyramidCapacity.fits`), then the counts that the data has. Sizes are then those of the capacity.
            Behind the data follow padding rows that nothing reads: no cluster, patch or pair lists them, each is a
            voxel of its own, pooled to 0; ``rows`` lists those that sleep. All rows are such where a count exceeds its
            capacity.
    """

    rows: Tensor
    cu_rows: Tensor
    stages: tuple[Stage, ...]
    found: Tensor | None = None

    def of_rows(self, rows: Tensor, n_rows: Tensor) -> Pyramid:
        """This pyramid, made with capacity of ``rows`` of an input, as one of that input.

        Args:
            rows: int64, of the input.
            n_rows: int64, how many of the input there should have been; more than ``rows`` do not fit.
        """
        problems, n_found = self.found[:1], n_rows.view(1)
        problems = problems | PyramidCapacity.TOO_LARGE * (n_found > rows.shape[0])
        found = torch.cat([problems, torch.maximum(self.found[1:2], n_found), self.found[2:]])
        return dataclasses.replace(self, rows=rows[self.rows], found=found)


@dataclass(frozen=True)
class PyramidCapacity:
    """How large the results of :func:`build_pyramid` are whatever the data, so that nothing waits for their sizes.

    Attributes:
        n_stages: levels.
        sizes: rows, clouds, patches and keys of every level, then the pairs of every kernel map. Level 0 has capacity
            for all input rows.
    """

    n_stages: int
    sizes: tuple[int, ...]

    MALFORMED, TOO_LARGE = 7, 8  # bits of Pyramid.found[0]

    @classmethod
    def of(cls, pyramid: Pyramid, n_rows: int, factor: float = 1.25) -> PyramidCapacity:
        """Capacity for a multiple of what a pyramid holds.

        Args:
            pyramid: of the data.
            n_rows: input rows it was made of.
            factor: 1 or more.
        """
        counts = []
        for stage in pyramid.stages:
            table = stage.patches[0]
            counts += [stage.n_rows, stage.n_clouds, table.cu_q.shape[0] - 1, table.kv_rows.shape[0]]
        counts += [m.tap_in.shape[0] for stage in pyramid.stages for m in stage.kernel_maps.values()]
        return cls(len(pyramid.stages), (n_rows,) + (0,) * (len(counts) - 1)).grown((0, *counts), factor)

    def grown(self, found: Sequence[int], factor: float = 1.25) -> PyramidCapacity:
        """This capacity, or ``factor`` times what was found where that is more.

        Args:
            found: numbers of ``Pyramid.found``.
            factor: 1 or more.
        """
        wanted = [math.ceil(factor * count) for count in found[1:]]
        n_rows = self.sizes[0] if found[1] <= self.sizes[0] else wanted[0]
        for rows in range(0, N_COUNTS * self.n_stages, N_COUNTS):
            wanted[rows] = min(wanted[rows], n_rows)  # no stage has more rows than go in
        return PyramidCapacity(self.n_stages, tuple(max(a, b) for a, b in zip(self.sizes, wanted, strict=True)))

    def of_rows(self, n_rows: int) -> PyramidCapacity:
        """This capacity where no more than ``n_rows`` rows go in."""
        of_rows = range(0, N_COUNTS * self.n_stages, N_COUNTS)
        sizes = (min(size, n_rows) if i in of_rows else size for i, size in enumerate(self.sizes))
        return PyramidCapacity(self.n_stages, tuple(sizes))

    def fits(self, found: Sequence[int]) -> bool:
        """Whether the data of a call fitted.

        Args:
            found: numbers of ``Pyramid.found``.
        Raises:
            ValueError: the clouds of the call were malformed, which on CUDA is known only now.
        """
        if found[0] & self.MALFORMED:
            names = "cu_rows, cloud_scene, cloud_slot or origin"
            raise ValueError(f"build_pyramid: {names} is malformed; a call without capacity names it")
        return not found[0] & self.TOO_LARGE


def build_pyramid(
    positions: Tensor,
    cu_rows: Tensor,
    cloud_scene: Tensor,
    cloud_slot: Tensor,
    origin: Tensor,
    spec: PyramidSpec,
    *,
    curves: tuple[tuple[int, ...], ...] | None = None,
    capacity: PyramidCapacity | None = None,
    rounded: bool = False,
    depth: int | None = None,
) -> Pyramid:
    """All geometry of a call of the dynamics network.

    Cells of stage 0 are ``floor((p - origin) / grid_size)`` in float64; a row outside [0, 2^16) cells or not finite
    sleeps: it is in no stage and not in ``Pyramid.rows``. Rows of a cloud are ordered along four curves of 16 levels,
    equal codes by position (x, then y, then z), then by row. The next stage pools the rows that share a cell of
    ``stride`` cells, in the order of serialization row 0, and merges clouds of a scene whose slots differ in the merged
    bits only.
    A cloud's geometry depends on its scene alone, not on the other scenes of the call (except with ``spec.release``).

    Args:
        positions: [N, 3] metres, float32 or float64; rows of cloud q are cu_rows[q] .. cu_rows[q + 1].
        cu_rows: int64 [Q + 1].
        cloud_scene: int64 [Q] in [0, B).
        cloud_slot: int64 [Q] in [0, 2^slot_bits), different for the clouds of a scene. Clouds without rows are fine.
        origin: float64 [B, 3] metres, lower corner of each scene.
        spec: the network's strides, windows, patch and kernel sizes.
        curves: per stage the curve (index into CURVES) of each of the four serialization rows; default (0, 1, 2, 3).
        capacity: sizes of the results; None: what the data needs.
        rounded: sizes are what the data needs and up to one part in 32 more, so that many calls share few sizes, which
            libraries of matrix products choose an algorithm for; not with ``capacity``.
        depth: levels of the curves, 1 to 16, where they are to be those of another project (Pointcept: the bits of the
            largest coordinate of a cell in the call; see :class:`gsim3d.nn.PointTransformerV3`). A row outside
            [0, 2^depth) cells sleeps; a stride of more levels than are left pools none. Default 16; not with
            ``spec.release``.
    Returns:
        Pyramid; tensors int64 on the device of ``positions``. On CUDA the call waits once, for the sizes; with
        ``capacity`` never: a CUDA graph can capture it, and ``Pyramid.found`` tells later whether the data fitted.
    Gradients:
        none, since results are integers.
    Determinism:
        the order of the rows of a cloud permutes the results only.
    Raises:
        ValueError: an argument is malformed; the message names it. With ``capacity`` on CUDA, malformed clouds give an
            empty pyramid instead, see :meth:`PyramidCapacity.fits`.
    Source:
        grid pooling and serialization of Point Transformer V3 (Wu et al. 2024), time merging of 3DGSim.

    Example:
        >>> spec = PyramidSpec(0.1, 0, (2,), (1,), (8, 8), ((3,), (3,)))
        >>> points = torch.tensor([[0.05, 0.05, 0.05], [0.15, 0.05, 0.05], [0.55, 0.05, 0.05]])
        >>> zero = torch.zeros(1, dtype=torch.int64)
        >>> origin = torch.zeros(1, 3, dtype=torch.float64)
        >>> pyramid = build_pyramid(points, torch.tensor([0, 3]), zero, zero, origin, spec)
        >>> pyramid.stages[1].grid
        tensor([[0, 0, 0],
                [2, 0, 0]])
    """
    if not torch.compiler.is_compiling():
        names = {"positions": positions, "cu_rows": cu_rows, "cloud_scene": cloud_scene, "cloud_slot": cloud_slot}
        check_tensors("build_pyramid", **names, origin=origin)
        _check_spec(spec, curves, rounded)
        if not (capacity is None or isinstance(capacity, PyramidCapacity)):
            raise TypeError(f"build_pyramid: capacity must be a PyramidCapacity; got {type(capacity).__name__}")
        if depth is not None:
            _check_depth("build_pyramid", depth)
    if curves is None:
        curves = ((0, 1, 2, 3),) * spec.n_stages
    cu_kernels = list(accumulate(map(len, spec.kernel_sizes), initial=0))
    flat_curves, flat_sizes = ([value for row in rows for value in row] for rows in (curves, spec.kernel_sizes))
    arrays = torch.ops.gsim3d.build_pyramid(
        *(positions.detach(), cu_rows, cloud_scene, cloud_slot, origin, spec.grid_size, spec.slot_bits, spec.strides),
        *(spec.merge_windows, spec.patch_sizes, flat_curves, flat_sizes, cu_kernels, spec.release),
        *(() if capacity is None else capacity.sizes, rounded, depth or 0),
    )
    counts = None
    if rounded and not torch.compiler.is_compiling():
        counts = arrays[-1].tolist()[1:][: N_COUNTS * spec.n_stages : N_COUNTS]
    with Streams(positions, MANY_STREAMS) as streams:
        return _assemble(arrays, spec, counts, capacity is not None or rounded, streams)


def _check_depth(op: str, depth: int) -> None:
    check_whole(op, depth=depth)
    if not torch.compiler.is_compiling() and not 1 <= depth <= 16:
        raise ValueError(f"{op}: depth must be in [1, 16]; got {depth}")


def _check_spec(spec: PyramidSpec, curves: tuple[tuple[int, ...], ...] | None, rounded: bool) -> None:
    check_real("build_pyramid", grid_size=spec.grid_size)
    check_whole("build_pyramid", slot_bits=spec.slot_bits)
    for name, flag in {"release": spec.release, "rounded": rounded}.items():
        if not isinstance(flag, bool):
            raise TypeError(f"build_pyramid: {name} must be true or false; got {flag!r}")
    for name in ("strides", "merge_windows", "patch_sizes"):
        _check_whole_numbers(name, getattr(spec, name))
    for name, rows in {"kernel_sizes": spec.kernel_sizes, "curves": curves or ()}.items():
        if not isinstance(rows, (tuple, list)):
            raise TypeError(f"build_pyramid: {name} must be a tuple with one entry a stage; got {rows!r}")
        if name == "kernel_sizes" and len(rows) != spec.n_stages:
            raise ValueError(f"build_pyramid: kernel_sizes must have {spec.n_stages} entries; got {len(rows)}")
        for row in rows:
            _check_whole_numbers(name, row)


def _check_whole_numbers(name: str, values: tuple[int, ...]) -> None:
    if not isinstance(values, (tuple, list)):
        raise TypeError(f"build_pyramid: {name} must be a tuple of whole numbers; got {values!r}")
    for value in values:
        check_whole("build_pyramid", **{name: value})


def _kernel_map(size: int, voxels: Voxels, taps: tuple[Tensor, Tensor, Tensor], streams: Streams) -> KernelMap:
    """Plans have K^3 entries a row; that of the stem, one convolution a network call, is kept for its gradient only."""
    plan = None
    if taps[0].is_cuda and (size == 3 or (size == 5 and torch.is_grad_enabled())):
        make = torch.ops.gsim3d.sparse_conv_plan
        plan = streams.run(make, voxels.row_voxel, voxels.rows, voxels.cu_rows, *taps, size)
    return KernelMap(size, *taps, plan)


def _assemble(
    arrays: list[Tensor], spec: PyramidSpec, counts: list[int] | None, has_found: bool, streams: Streams
) -> Pyramid:
    """Names the flat results, in the order that csrc/gsim3d/curve/pyramid.h states. ``counts``: rows of data of each
    stage, where that is not all and the host knows it."""
    take = list(reversed(arrays)).pop
    rows, cu_rows, stages = take(), take(), []
    for sizes, merged in zip(spec.kernel_sizes, spec.merged_bits(), strict=True):
        cluster = Segments(stages[-1].order[0], take()) if stages else None
        time_index = take() if merged else None
        grid, cloud, cu_clouds, order, cu_q, cu_k, kv_rows = [take() for _ in range(7)]
        patches = tuple(PatchTable(order[r], kv_rows[r], cu_q, cu_k) for r in range(4))
        voxels = Voxels(take(), take(), take())
        kernel_maps = {size: _kernel_map(size, voxels, (take(), take(), take()), streams) for size in sizes}
        n_data = counts[len(stages)] if counts else None if has_found else grid.shape[0]
        stages.append(Stage(grid, cloud, cu_clouds, order, patches, voxels, kernel_maps, cluster, time_index, n_data))
    return Pyramid(rows, cu_rows, tuple(stages), take() if has_found else None)


def _pyramid(positions, cu_rows, cloud_scene, cloud_slot, origin, grid_size, slot_bits, strides, merge_windows, *rest):
    patch_sizes, _, kernel_sizes, cu_kernels, _, capacity, *rounded_and_depth = rest
    n_counts = N_COUNTS * len(patch_sizes)
    of_stages, of_maps = iter(capacity[:n_counts]), iter(capacity[n_counts:])

    def size(given=of_stages, more=0):  # one symbol: an unbacked size must be the whole size of some result
        return next(given) + more if capacity else torch.library.get_ctx().new_dynamic_size(min=more)

    n = size()
    arrays = [(n,), (n + 1,)]
    for s in range(len(patch_sizes)):
        if s > 0:
            n = size()
            arrays.append((n + 1,))
            merged = min(merge_windows[s - 1].bit_length() - 1, slot_bits)
            slot_bits -= merged
            arrays += [(n,)] if merged else []
        clouds, patches, keys = size(more=1), size(more=1), size()
        arrays += [(n, 3), (n,), (clouds,), (4, n), (patches,), (patches,), (4, keys)]
        arrays += [(n,), (n,), (n + 2 if capacity else size(more=1),)]
        for kernel_size in kernel_sizes[cu_kernels[s] : cu_kernels[s + 1]]:
            n_pairs = size(of_maps)
            arrays += [(n_pairs,), (n_pairs,), (kernel_size**3 + 1,)]
    if capacity or any(rounded_and_depth[:1]):
        arrays.append((1 + n_counts + len(kernel_sizes),))
    return [cu_rows.new_empty(shape) for shape in arrays]


fakes(
    curve_encode=lambda grid, cloud, curves, depth, shift: grid.new_empty(len(curves), grid.shape[0]),
    curve_sort=lambda codes: (codes.new_empty(codes.shape), codes.new_empty(codes.shape)),
    build_pyramid=_pyramid,
)
