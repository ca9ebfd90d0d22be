"""Layer normalisation row by row, in float64."""

import torch


def row_norm(x, weight, bias, residual=None, eps=1e-5):
    rows = []
    for row in x:
        centered = row - row.sum() / row.numel()
        rows.append(centered / torch.sqrt((centered * centered).sum() / row.numel() + eps) * weight + bias)
    out = torch.stack(rows) if rows else torch.zeros_like(x)
    return out if residual is None else out + residual


def residual_norm(x, branch, keep, branch_norm, norm, eps=1e-5):
    """(sum, out)."""
    branch = branch if branch_norm is None else row_norm(branch, *branch_norm, eps=eps)
    total = x + (branch if keep is None else keep * branch)
    return total, total if norm is None else row_norm(total, *norm, eps=eps)


def norm_gelu(x, mean, scale, bias):
    y = (x - mean) * scale + bias
    return y * (1 + torch.erf(y / 2**0.5)) / 2
