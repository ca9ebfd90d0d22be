"""Patch attention as one dense softmax: a matrix counts how often a query's patch lists a key.

Imports nothing from gsim3d.
"""

import torch


def patch_of_entries(cu):
    """The patch of each listed row."""
    counts = cu[1:] - cu[:-1]
    return torch.repeat_interleave(torch.arange(counts.shape[0]), counts)


def multiplicity(q_rows, kv_rows, cu_q, cu_k, n_q, n_k):
    """[n_q, n_k]: how many entries of the query's patch are that key."""
    n_patches = cu_q.shape[0] - 1
    listed = torch.zeros(n_patches, n_k, dtype=torch.float64)
    ones = torch.ones(kv_rows.shape[0], dtype=torch.float64)
    listed.index_put_((patch_of_entries(cu_k), kv_rows), ones, accumulate=True)
    counts = torch.zeros(n_q, n_k, dtype=torch.float64)
    counts[q_rows] = listed[patch_of_entries(cu_q)]
    return counts


def patch_attention(q, k, v, q_rows, kv_rows, cu_q, cu_k, scale):
    """q [Nq, H, D], k and v [Nk, H, D]; computes in float64, differentiable by autograd."""
    q, k, v = (x.double() for x in (q, k, v))
    counts = multiplicity(q_rows, kv_rows, cu_q, cu_k, q.shape[0], k.shape[0])
    if k.shape[0] == 0:
        return q * 0
    logits = scale * torch.einsum("ihd,jhd->hij", q, k)
    largest = logits.detach().masked_fill(counts == 0, -torch.inf).amax(-1, keepdim=True)
    largest = largest.masked_fill(largest == -torch.inf, 0.0)
    weights = counts * torch.exp(torch.where(counts > 0, logits - largest, -torch.inf))
    total = weights.sum(-1, keepdim=True)
    return torch.einsum("hij,jhd->ihd", weights / torch.where(total > 0, total, 1.0), v)
