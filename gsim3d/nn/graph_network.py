"""A graph network over packed point clouds of several time steps, in place of the point transformer.

A voxel graph: the particles of a step that share a cell of the grid are one node, at their mean position. To each node
of the newest step lead edges from all nodes in its cell and those around: in a first round of message passing from
earlier steps, in later rounds from the newest. Positions enter as differences only; invariant to translation by whole
cells only (untrained, a quarter of a cell changes displacements by 0.20 of them).
Source:
    Graph Network-based Simulators (Sanchez-Gonzalez et al. 2020); nodes and edges interact as of Battaglia et al. 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from gsim3d import ops
from gsim3d.errors import check_ranges
from gsim3d.nn.layers import RowLayerNorm, RowLinear, widened
from gsim3d.nn.point_transformer import COLUMN_MULTIPLE, Extension, Head, TransformerConfig
from gsim3d.ops.curve import Pyramid, PyramidSpec, Segments, Stage

KERNEL = 3  # edge in cells of the cube around a node whose nodes it reads
PATCH = 1024  # no patch is read, and a few are made sooner than many
MAX_HISTORY_BITS = 5  # edges to a node grow with the steps of a history


@dataclass(frozen=True, kw_only=True)
class GraphConfig:
    """Size of a :class:`GraphNetwork`. A node is a cell of ``grid_size``, with edges to the 27 cells around it."""

    channels: int = 128  #: of a node, and of an edge
    layers: int = 8  #: rounds of message passing between the nodes of the newest step

    def __post_init__(self):
        check_ranges(self, channels=(1, 10**5), layers=(0, 100))


def graph_spec(grid_size: float, history_bits: int) -> PyramidSpec:
    """Geometry of a graph network: particles, then their cells, in which the steps of a history share a cloud."""
    return PyramidSpec(grid_size, history_bits, (1,), (2**history_bits,), (PATCH,) * 2, ((), (KERNEL,)))


@dataclass(frozen=True)
class Graph:
    """E edges between N nodes, sorted by receiver; edges behind the last receiver's join none."""

    senders: Segments  #: edges that each node sends
    receivers: Segments  #: edges that each node receives
    age: Tensor  #: [E, 1], steps by which the sender is older than the receiver, over the longest history

    @classmethod
    def of(cls, stage: Stage, longest: int, like: Tensor, *, earlier: bool) -> Graph:
        """Joins the nodes of ``stage``, without a device sync. ``longest``: steps of the longest history; ``like``: has
        the dtype of ``age``; ``earlier``: senders are the nodes of earlier steps, or else those of the newest."""
        voxels, taps = stage.voxels, stage.kernel_maps[KERNEL]
        cells = torch.arange(voxels.cu_rows.shape[0] - 1, device=like.device)
        node_at = _nodes_by_slot(stage, cells, longest if stage.time_index is not None else 1)
        steps = slice(None, -1) if earlier else slice(-1, None)
        senders = node_at[:, steps][torch.cat([taps.tap_in, cells])]
        receivers = node_at[torch.cat([taps.tap_out, cells]), -1:].expand_as(senders)
        is_pair = torch.arange(taps.tap_in.shape[0], device=cells.device) < taps.cu_taps[-1]
        joined = F.pad(is_pair, (0, cells.shape[0]), value=True)[:, None]
        joined = joined & (senders < stage.n_rows) & (receivers < stage.n_rows)
        age = torch.arange(node_at.shape[1], device=cells.device).flip(0)[steps].expand_as(senders)
        senders, receivers = (torch.where(joined, ends, stage.n_rows).flatten() for ends in (senders, receivers))
        order, _ = ops.curve_sort(receivers[None])
        age = age.reshape(-1, 1)[order[0]].to(like) / longest
        return cls(_ends(senders[order[0]], stage.n_rows), _ends(receivers[order[0]], stage.n_rows), age)

    def at_edges(self, x: Tensor, ends: Segments) -> Tensor:
        """Values of nodes [N, C] at the edges [E, C] of which they are the senders, or the receivers."""
        return ops.unpool(x, ends.rows, ends.cu_rows, self.age.shape[0], check=False)

    def features(self, positions: Tensor) -> Tensor:
        """[E, 5]: difference of positions, its square, age."""
        apart = self.at_edges(positions, self.senders) - self.at_edges(positions, self.receivers)
        return torch.cat([apart, apart.square().sum(1, keepdim=True), self.age], 1)


def _nodes_by_slot(stage: Stage, cells: Tensor, slots: int) -> Tensor:
    """The node of each cell and time slot, int64 [V, slots]; one more than the last: there is none.

    A search among the nodes, which ascend by cell and slot: on CUDA torch's deterministic scatter waits for the device.
    """
    voxels, slot = stage.voxels, 0 if stage.time_index is None else stage.time_index
    known = (voxels.row_voxel * slots + slot)[voxels.rows]
    wanted = (cells[:, None] * slots + torch.arange(slots, device=cells.device)).contiguous()
    place = torch.searchsorted(known, wanted)
    known, nodes = F.pad(known, (0, 1), value=-1), F.pad(voxels.rows, (0, 1))
    return torch.where(known[place] == wanted, nodes[place], stage.n_rows)


def _ends(nodes: Tensor, n_nodes: int) -> Segments:
    """The edges of each node, from its node of each edge; ``n_nodes``: none."""
    rows = ops.curve_sort(nodes[None])[0][0]
    return Segments(rows, torch.searchsorted(nodes[rows], torch.arange(n_nodes + 1, device=nodes.device)))


class Perceptron(nn.Module):
    """Two linear layers and a norm, of inputs that are padded to whole columns; never returns 16 bits."""

    def __init__(self, in_channels: int, channels: int):
        super().__init__()
        self.fc1 = RowLinear(in_channels + -in_channels % COLUMN_MULTIPLE, channels)
        self.fc2 = RowLinear(channels, channels)
        self.norm = RowLayerNorm(channels)

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        x = F.pad(x, (0, self.fc1.in_features - x.shape[1]))
        return widened(self.norm(self.fc2(self.fc1(x, gelu=True)), residual))


class Interaction(nn.Module):
    """A round of message passing: edges read the nodes that they join, then nodes the sum of the edges they receive."""

    def __init__(self, channels: int):
        super().__init__()
        self.edge, self.sender, self.receiver = (RowLinear(channels, channels) for _ in range(3))
        self.message, self.edge_norm = RowLinear(channels, channels), RowLayerNorm(channels)
        self.node = Perceptron(2 * channels, channels)

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """Nodes [N, C] and edges [E, C] after the round."""
        ends = graph.at_edges(self.sender(nodes), graph.senders)
        ends = ends + graph.at_edges(self.receiver(nodes), graph.receivers)
        edges = self.edge_norm(self.message(F.gelu(self.edge(edges) + ends)), edges)
        total = ops.segment_sum(edges, graph.receivers.cu_rows, check=False)
        return self.node(torch.cat([nodes, total], 1), nodes), edges


class GraphNetwork(nn.Module):
    """Features of all clouds -> features [N, channels] of the same particles, and a head.

    It reads x [N, 3 + in_channels], positions in cells, then features of the particles of stage 0, and their geometry
    of :func:`graph_spec`; not what else :class:`gsim3d.nn.point_transformer.PointTransformer` reads.
    """

    def __init__(
        self,
        size: GraphConfig,
        in_channels: int,
        out_channels: int,
        config: TransformerConfig,
        extensions: Sequence[Extension] = (),
    ):
        super().__init__()
        channels, self.longest, self.checkpointing = size.channels, 2**config.history_bits, config.checkpointing
        self.lift, self.lower = Perceptron(3 + in_channels, channels), Perceptron(2 * channels, channels)
        self.history_edge, self.edge = Perceptron(5, channels), Perceptron(5, channels)
        self.history = Interaction(channels)
        self.layers = nn.ModuleList(Interaction(channels) for _ in range(size.layers))
        self.head = Head(channels, out_channels, config.zero_init, extensions)

    def forward(
        self, x: Tensor, pyramid: Pyramid, *, generator: torch.Generator | None = None, contexts: Sequence = ()
    ) -> Tensor:
        stage = pyramid.stages[1]
        rows, cu_rows = stage.cluster.rows, stage.cluster.cu_rows
        positions, features = x.split([3, x.shape[1] - 3], 1)
        at = ops.pool_mean(positions, rows, cu_rows, check=False)
        apart = positions - ops.unpool(at, rows, cu_rows, x.shape[0], check=False)
        x = self.lift(torch.cat([apart, features], 1))
        nodes = ops.pool_mean(x, rows, cu_rows, check=False)
        again = self.checkpointing and self.training and torch.is_grad_enabled()
        run = partial(checkpoint, use_reentrant=False, preserve_rng_state=False) if again else nn.Module.__call__
        graph = Graph.of(stage, self.longest, at, earlier=True)
        nodes, _ = run(self.history, nodes, self.history_edge(graph.features(at)), graph)
        graph = Graph.of(stage, self.longest, at, earlier=False)
        edges = self.edge(graph.features(at))
        for layer in self.layers:
            nodes, edges = run(layer, nodes, edges, graph)
        return self.lower(torch.cat([x, ops.unpool(nodes, rows, cu_rows, x.shape[0], check=False)], 1), x)
