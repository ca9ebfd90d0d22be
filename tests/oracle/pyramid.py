"""The geometry of a network call with dictionaries and loops. Imports nothing from gsim3d."""

import math
from itertools import product

from tests.oracle.curve import CURVES, code

CELLS = 2**16


def cell_of(position, origin, grid_size):
    """Cell of a position, None where the row sleeps."""
    if not all(math.isfinite(p) for p in position):
        return None
    cell = tuple(math.floor((p - o) / grid_size) for p, o in zip(position, origin))
    return cell if all(0 <= c < CELLS for c in cell) else None


def patches(clouds, patch_size):
    """(query rows, key rows) of each patch; ``clouds`` are the sorted rows of each cloud."""
    result = []
    for rows in clouds:
        for begin in range(0, len(rows), patch_size):
            queries = rows[begin : begin + patch_size]
            end = begin + len(queries)
            result.append((queries, rows[max(0, end - patch_size) : end]))
    return result


def kernel_map(voxels, kernel_size):
    """Per tap the pairs (in, out); ``voxels`` are (cloud, x, y, z) by id."""
    ids = {voxel: i for i, voxel in enumerate(voxels)}
    radius = kernel_size // 2
    result = []
    for offset in product(range(-radius, radius + 1), repeat=3):
        pairs = []
        for out, (cloud, *cell) in enumerate(voxels):
            neighbour = ids.get((cloud, *(c + o for c, o in zip(cell, offset))))
            if neighbour is not None and any(offset):
                pairs.append((neighbour, out))
        result.append(pairs)
    return result


def stage_geometry(rows, depth, curves, patch_size, kernel_sizes):
    """Orders, patches, voxels and maps of ``rows``: (scene and slot of the cloud, cell, what orders equal cells)."""
    keys = sorted({key for key, _, _ in rows})
    cloud = [keys.index(key) for key, _, _ in rows]
    grid = [cell for _, cell, _ in rows]
    orders = []
    for curve in curves:
        codes = [code(*cell, CURVES[curve], depth) for cell in grid]
        orders.append(sorted(range(len(rows)), key=lambda i: (cloud[i], codes[i], rows[i][2], i)))
    by_cloud = [[[i for i in order if cloud[i] == c] for c in range(len(keys))] for order in orders]
    members = {}
    for i in range(len(rows)):
        members.setdefault((cloud[i], *grid[i]), []).append(i)
    voxels = sorted(members)
    return {
        "grid": grid,
        "cloud": cloud,
        "cloud_sizes": [cloud.count(c) for c in range(len(keys))],
        "order": orders,
        "patches": [patches(clouds, patch_size) for clouds in by_cloud],
        "voxels": [members[voxel] for voxel in voxels],
        "kernel_maps": {size: kernel_map(voxels, size) for size in kernel_sizes},
    }


def build_pyramid(positions, cu_rows, scenes, slots, origin, spec, curves):
    """``spec`` has the fields of PyramidSpec; positions and origin are lists. Returns (rows, stages)."""
    kept, rows = [], []
    for q, (scene, slot) in enumerate(zip(scenes, slots)):
        for i in range(cu_rows[q], cu_rows[q + 1]):
            cell = cell_of(positions[i], origin[scene], spec.grid_size)
            if cell is not None:
                kept.append(i)
                rows.append(((scene, slot), cell, tuple(positions[i])))
    depth, slot_bits = 16, spec.slot_bits
    stages = []
    for s in range(len(spec.patch_sizes)):
        if s > 0:
            drop = int(math.log2(spec.strides[s - 1]))
            merged = min(int(math.log2(spec.merge_windows[s - 1])), slot_bits)
            depth, slot_bits = depth - drop, slot_bits - merged
            clusters = {}
            for i in stages[-1]["order"][0]:
                key, cell, _ = rows[i]
                clusters.setdefault((key, tuple(c >> drop for c in cell)), []).append(i)
            time_index = [slot % 2**merged for (_, slot), _ in clusters] if merged else None
            rows = [((scene, slot >> merged), cell, ()) for (scene, slot), cell in clusters]
        stages.append(stage_geometry(rows, depth, curves[s], spec.patch_sizes[s], spec.kernel_sizes[s]))
        stages[-1]["cluster"] = list(clusters.values()) if s > 0 else None
        stages[-1]["time_index"] = time_index if s > 0 else None
    return kept, stages
