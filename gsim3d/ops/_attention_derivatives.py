"""Derivatives of attention that kernels do not compute: forward mode, and the gradient of its gradient.

Written out in plain tensors with the scores of all patches stored, each padded to the largest one; their size is found
by waiting for the device once. With P the softmax of S = scale Q K^T and O = P V, along a direction (A, B, C):

    S' = scale (A K^T + Q B^T),  P' = P (S' - sum P S'),  O' = P' V + P C.

The gradient of <dQ, A> + <dK, B> + <dV, C>, where dQ, dK, dV are the gradients of <G, O>, is that of <G, O'>.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsim3d.ops._arguments import widened
from gsim3d.ops._register import call


class Patches:
    """Rows of queries and keys by patch, [P, longest], and back."""

    def __init__(self, lists: Sequence[Tensor], n_q: int, n_k: int):
        q_rows, kv_rows, cu_q, cu_k = lists
        self.n_q, self.n_k = n_q, n_k
        self.queries, self.has_query = _padded(q_rows, cu_q, n_q)
        self.keys, self.has_key = _padded(kv_rows, cu_k, n_k)
        listed = torch.where(self.has_key, self.keys, n_k).flatten()
        sorted_rows, self.key_order = torch.sort(listed, stable=True)
        self.cu_keys = torch.searchsorted(sorted_rows, torch.arange(n_k + 1, device=listed.device))

    def of_queries(self, x: Tensor) -> Tensor:
        """[P, H, Lq, D] of x [Nq, H, D]; 0 where a patch is shorter."""
        if self.queries.numel() == 0:
            return x.new_zeros(*self.queries.shape, *x.shape[1:]).transpose(1, 2)
        return torch.where(self.has_query[..., None, None], x[self.queries], 0).transpose(1, 2)

    def of_keys(self, x: Tensor) -> Tensor:
        """[P, H, Lk, D] of x [Nk, H, D]; 0 where a patch is shorter."""
        rows = call("unpool", _flat(x), self.key_order, self.cu_keys, self.key_order.shape[0])
        return rows.reshape(*self.keys.shape, *x.shape[1:]).transpose(1, 2)

    def to_queries(self, x: Tensor) -> Tensor:
        """[Nq, H, D] of x [P, H, Lq, D]; 0 where no patch lists a row."""
        x = x.transpose(1, 2).flatten(0, 1)
        rows = torch.where(self.has_query, self.queries, self.n_q).flatten()
        return x.new_zeros(self.n_q + 1, *x.shape[1:]).index_copy(0, rows, x)[: self.n_q]

    def to_keys(self, x: Tensor) -> Tensor:
        """[Nk, H, D], the sums over slots in the order of kv_rows, of x [P, H, Lk, D]."""
        x = x.transpose(1, 2).flatten(0, 1)
        return call("unpool_backward", _flat(x), self.key_order, self.cu_keys).reshape(self.n_k, *x.shape[1:])

    def softmax(self, scores: Tensor) -> Tensor:
        """Of scores [P, H, Lq, Lk]; 0 where a patch is shorter."""
        mask = self.has_key[:, None, None] & self.has_query[:, None, :, None]
        return scores.masked_fill(~mask, torch.finfo(scores.dtype).min).softmax(-1).masked_fill(~mask, 0)


def _padded(rows: Tensor, cu: Tensor, n: int) -> tuple[Tensor, Tensor]:
    lengths = cu.diff()
    longest = int(lengths.max()) if lengths.numel() else 0
    slots = torch.arange(longest, device=rows.device)
    has_row = slots < lengths[:, None]
    at = (cu[:-1, None] + slots).clamp(max=max(rows.shape[0] - 1, 0))
    return (rows[at] if rows.shape[0] else at), has_row


def _flat(x: Tensor) -> Tensor:
    return x.reshape(x.shape[0], x.shape[1] * x.shape[2])


def tangent(q, k, v, by_q, by_k, by_v, lists, scale: float) -> Tensor:
    """O' [Nq, H, D] along a direction (by_q, by_k, by_v)."""
    dtype = q.dtype
    q, k, v, by_q, by_k, by_v = map(widened, (q, k, v, by_q, by_k, by_v))
    patches = Patches(lists, q.shape[0], k.shape[0])
    q, by_q = map(patches.of_queries, (q, by_q))
    k, v, by_k, by_v = map(patches.of_keys, (k, v, by_k, by_v))
    weights = patches.softmax(scale * q @ k.mT)
    moved = scale * (by_q @ k.mT + q @ by_k.mT)
    out = (weights * (moved - (weights * moved).sum(-1, keepdim=True))) @ v + weights @ by_v
    return patches.to_queries(out).to(dtype)


def gradients_of_gradients(grad, q, k, v, by_q, by_k, by_v, lists, scale: float) -> tuple[Tensor, ...]:
    """The gradients of <dQ, by_q> + <dK, by_k> + <dV, by_v> with respect to grad, q, k and v."""
    dtype = q.dtype
    grad, q, k, v, by_q, by_k, by_v = map(widened, (grad, q, k, v, by_q, by_k, by_v))
    patches = Patches(lists, q.shape[0], k.shape[0])
    grad, q, by_q = map(patches.of_queries, (grad, q, by_q))
    k, v, by_k, by_v = map(patches.of_keys, (k, v, by_k, by_v))
    weights, by_weights = patches.softmax(scale * q @ k.mT), grad @ v.mT
    moved = scale * (by_q @ k.mT + q @ by_k.mT)
    mean_moved, mean_by = ((weights * x).sum(-1, keepdim=True) for x in (moved, by_weights))
    moved_weights = weights * (moved - mean_moved)
    by_scores = weights * (by_weights - mean_by)
    of_weights = moved * (by_weights - mean_by) - mean_moved * by_weights + grad @ by_v.mT
    of_scores = weights * (of_weights - (weights * of_weights).sum(-1, keepdim=True))
    of_queries = moved_weights @ v + weights @ by_v, scale * (of_scores @ k + by_scores @ by_k)
    of_keys = scale * (of_scores.mT @ q + by_scores.mT @ by_q), moved_weights.mT @ grad
    results = *map(patches.to_queries, of_queries), *map(patches.to_keys, of_keys)
    return tuple(x.to(dtype) for x in results)
