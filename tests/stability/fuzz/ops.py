"""Every op: good arguments of random sizes, of which up to three are mutated."""

from __future__ import annotations

import dataclasses
import inspect
import os
import random
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsim3d import ops
from gsim3d.cameras import Cameras
from gsim3d.errors import GradientError
from gsim3d.math.spherical_harmonics import readings
from gsim3d.state import ASLEEP
from tests.stability.fuzz.engine import Failure, Target, finite
from tests.stability.fuzz.poison import mutate, tensor

EXPECTED = (ValueError, TypeError, MemoryError)
Arguments = dict[str, Any]
STRUCTURES = ("cameras", "voxels", "kernel_map", "table", "spec", "fields", "springs")  # arguments that hold the others


def _size(rng: random.Random, most: int = 12) -> int:
    return rng.choice((0, 1, 1, 2, 3, 5, 8, most))


def _dtype(rng: random.Random) -> torch.dtype:
    return rng.choice((torch.float32, torch.float32, torch.float64))


def _offsets(rng: random.Random, total: int, parts: int) -> Tensor:
    """[parts + 1] from 0 to ``total``, ascending."""
    cuts = sorted(rng.randint(0, total) for _ in range(max(0, parts - 1)))
    return torch.tensor([0, *cuts, total] if parts else [0])


def _permutation(rng: random.Random, n: int) -> Tensor:
    return torch.tensor(rng.sample(range(n), n), dtype=torch.int64)


def _curve_encode(rng: random.Random) -> Arguments:
    n = _size(rng)
    grid = torch.tensor([[rng.randrange(2**16) for _ in range(3)] for _ in range(n)], dtype=torch.int64).reshape(n, 3)
    cloud = torch.tensor([rng.randrange(8) for _ in range(n)], dtype=torch.int64)
    curve = rng.choice((*ops.CURVES, ("z", "hilbert")))
    return {
        "grid": grid,
        "cloud": rng.choice((cloud, None)),
        "curve": curve,
        "depth": 16,
        "shift": rng.choice((None, 48)),
    }


def _curve_sort(rng: random.Random) -> Arguments:
    n, rows = rng.choice((0, 1, 9)), rng.choice((0, 1, 3))
    codes = [rng.randrange(2 ** rng.choice((2, 20, 62))) for _ in range(rows * n)]
    return {"codes": torch.tensor(codes, dtype=torch.int64).reshape(rows, n)}


def _pyramid(rng: random.Random) -> Arguments:
    n, clouds, bits = _size(rng, 40), rng.choice((1, 2, 4)), 2
    scenes = torch.arange(clouds) // 2
    return {
        "positions": tensor(rng, n, 3, dtype=_dtype(rng)).abs(),
        "cu_rows": _offsets(rng, n, clouds),
        "cloud_scene": scenes,
        "cloud_slot": torch.arange(clouds) % 2 + 2,
        "origin": torch.zeros((clouds + 1) // 2, 3, dtype=torch.float64),
        "grid_size": 0.1,
        "slot_bits": bits,
        "strides": (2, 4),
        "merge_windows": (2, 2),
        "patch_sizes": (16, 8, 4),
        "kernel_sizes": ((5, 3), (3,), (3,)),
        "release": rng.random() < 0.2,
        "curves": rng.choice((None, ((0, 1, 2, 3),) * 3, ((3, 2, 1, 0),) * 3)),
    }


def _call_pyramid(a: Arguments):
    spec = ops.PyramidSpec(**{f.name: a[f.name] for f in dataclasses.fields(ops.PyramidSpec)})
    first = [a[name] for name in ("positions", "cu_rows", "cloud_scene", "cloud_slot", "origin")]
    return ops.build_pyramid(*first, spec, curves=a["curves"])


def _geometry(rng: random.Random, n: int, kernel_size: int) -> tuple[ops.Voxels, ops.KernelMap]:
    sizes = ops.PyramidSpec(0.5, 0, (), (), (8,), ((kernel_size,),))
    zero, origin = torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.float64)
    stage = ops.build_pyramid(tensor(rng, n, 3).abs(), torch.tensor([0, n]), zero, zero, origin, sizes).stages[0]
    return stage.voxels, stage.kernel_maps[kernel_size]


def _sparse_conv(rng: random.Random) -> Arguments:
    n, k, c_in, c_out, dtype = (
        _size(rng),
        rng.choice((1, 3, 3, 5)),
        rng.choice((1, 3, 8)),
        rng.choice((1, 4)),
        _dtype(rng),
    )
    voxels, kernel_map = _geometry(rng, n, k)
    return {
        "x": tensor(rng, n, c_in, dtype=dtype),
        "weight": tensor(rng, c_out, k, k, k, c_in, dtype=dtype),
        "bias": rng.choice((tensor(rng, c_out, dtype=dtype), None)),
        **{name: getattr(voxels, name) for name in ("row_voxel", "rows", "cu_rows")},
        **{name: getattr(kernel_map, name) for name in ("kernel_size", "tap_in", "tap_out", "cu_taps")},
        "duplicates": rng.choice(("mean", "first")),
    }


def _call_sparse_conv(a: Arguments):
    voxels = ops.Voxels(a["row_voxel"], a["rows"], a["cu_rows"])
    kernel_map = ops.KernelMap(a["kernel_size"], a["tap_in"], a["tap_out"], a["cu_taps"])
    return ops.sparse_conv(a["x"], a["weight"], a["bias"], voxels, kernel_map, duplicates=a["duplicates"])


def _patch_attention(rng: random.Random) -> Arguments:
    n_q, n_k, heads, dim, dtype = _size(rng), _size(rng), rng.choice((1, 2)), rng.choice((4, 16, 20)), _dtype(rng)
    patches, n_list = rng.choice((1, 2, 5)), rng.choice((0, 1, 9)) if n_k else 0
    return {
        "q": tensor(rng, n_q, heads, dim, dtype=dtype),
        "k": tensor(rng, n_k, heads, dim, dtype=dtype),
        "v": tensor(rng, n_k, heads, dim, dtype=dtype),
        "q_rows": _permutation(rng, n_q),
        "kv_rows": torch.tensor([rng.randrange(n_k) for _ in range(n_list)], dtype=torch.int64),
        "cu_q": _offsets(rng, n_q, patches),
        "cu_k": _offsets(rng, n_list, patches),
        "scale": rng.choice((None, 1.0, 0.1)),
    }


def _call_patch_attention(a: Arguments):
    table = ops.PatchTable(a["q_rows"], a["kv_rows"], a["cu_q"], a["cu_k"])
    return ops.patch_attention(a["q"], a["k"], a["v"], table, scale=a["scale"])


def _joint_attention(rng: random.Random) -> Arguments:
    own = _patch_attention(rng)
    n_k, n_list, (n_q, heads, dim) = _size(rng), rng.choice((0, 1, 9)), own["q"].shape
    patches, n_list = rng.choice((1, 2, 5)), n_list if n_k else 0
    return {
        **own,
        "other_k": tensor(rng, n_k, heads, dim, dtype=own["q"].dtype),
        "other_v": tensor(rng, n_k, heads, dim, dtype=own["q"].dtype),
        "other_q_rows": _permutation(rng, n_q),
        "other_kv_rows": torch.tensor([rng.randrange(n_k) for _ in range(n_list)], dtype=torch.int64),
        "other_cu_q": _offsets(rng, n_q, patches),
        "other_cu_k": _offsets(rng, n_list, patches),
    }


def _call_joint_attention(a: Arguments):
    table, other = (
        ops.PatchTable(*(a[f"{prefix}{name}"] for name in ("q_rows", "kv_rows", "cu_q", "cu_k")))
        for prefix in ("", "other_")
    )
    return ops.joint_attention(a["q"], a["k"], a["v"], a["other_k"], a["other_v"], table, other, scale=a["scale"])


def _row_scenes(rng: random.Random) -> Arguments:
    n, clouds = _size(rng), rng.choice((0, 1, 3))
    n, stages, arguments = n if clouds else 0, rng.choice((0, 1, 2)), {}
    below = n
    for s in range(2):
        segments = rng.choice((0, 1, 3)) if below else 0
        rows = _permutation(rng, below)[: below if segments else 0]
        arguments |= {f"stages[{s}].rows": rows, f"stages[{s}].cu_rows": _offsets(rng, len(rows), segments)}
        below = segments
    used = {name: value for name, value in arguments.items() if int(name[7]) < stages}
    return {"cloud_scene": torch.arange(clouds) // 2, "cu_input": _offsets(rng, n, clouds), **used}


def _call_row_scenes(a: Arguments):
    stages = [ops.Segments(a[f"stages[{s}].rows"], a[f"stages[{s}].cu_rows"]) for s in range((len(a) - 2) // 2)]
    return ops.row_scenes(a["cloud_scene"], a["cu_input"], stages)


def _find_cells(rng: random.Random) -> Arguments:
    n, cells = _size(rng), sorted(rng.randrange(2**62) for _ in range(rng.choice((0, 1, 9))))
    grid = torch.tensor([[rng.randrange(2**16) for _ in range(3)] for _ in range(n)], dtype=torch.int64).reshape(n, 3)
    scene = torch.tensor([rng.randrange(8) for _ in range(n)], dtype=torch.int64)
    return {"cells": torch.tensor([*cells, 2**63 - 1]), "scene": scene, "grid": grid}


def _add_cells(rng: random.Random) -> Arguments:
    n, n_cells, channels, dtype = _size(rng), rng.choice((1, 5)), rng.choice((1, 4, 8)), _dtype(rng)
    return {
        "x": tensor(rng, n, channels, dtype=dtype),
        "field": tensor(rng, n_cells, channels, dtype=dtype),
        "places": torch.tensor([rng.randrange(n_cells) for _ in range(n)], dtype=torch.int64),
    }


def _overlapping_patches(rng: random.Random) -> Arguments:
    n, curves, patches, size = _size(rng), rng.choice((1, 4)), rng.choice((0, 1, 3)), rng.choice((1, 4))
    counts = [rng.randint(0, size) for _ in range(patches)]
    keys, scene = sum(counts), rng.choice((0, 1)) << 48
    codes = torch.tensor([rng.randrange(9) for _ in range(curves * n)], dtype=torch.int64).reshape(curves, n)
    begins = [[0, *sorted(rng.randrange(9) for _ in range(patches - 1))][:patches] for _ in range(curves)]
    return {
        "first": torch.tensor(begins, dtype=torch.int64).reshape(curves, patches),
        "kv_rows": torch.arange(curves * keys).reshape(curves, keys),
        "cu_k": torch.tensor([0, *counts]).cumsum(0),
        "codes": codes | scene,
        "order": codes.argsort(dim=1, stable=True),
        "cu_clouds": torch.tensor([0, n]),
        "patch_size": size,
    }


def _pool(rng: random.Random) -> Arguments:
    n, segments = _size(rng), rng.choice((0, 1, 3))
    rows = _permutation(rng, n)[: n if segments else 0]
    return {
        "x": tensor(rng, n, rng.choice((1, 3, 17)), dtype=_dtype(rng)),
        "rows": rows,
        "cu_rows": _offsets(rng, len(rows), segments),
    }


def _segment(rng: random.Random) -> Arguments:
    n = _size(rng)
    return {"x": tensor(rng, n, 3, dtype=_dtype(rng)), "cu_rows": _offsets(rng, n, rng.choice((0, 1, 3)) if n else 0)}


def _unpool(rng: random.Random) -> Arguments:
    arguments = _pool(rng)
    n, segments = len(arguments["x"]), len(arguments["cu_rows"]) - 1
    return {**arguments, "x": tensor(rng, segments, 5, dtype=_dtype(rng)), "n_rows": n}


def _row_norm(rng: random.Random) -> Arguments:
    n, channels, dtype = _size(rng), rng.choice((1, 4, 33)), _dtype(rng)
    return {
        "x": tensor(rng, n, channels, dtype=dtype),
        "weight": tensor(rng, channels, dtype=dtype),
        "bias": tensor(rng, channels, dtype=dtype),
        "residual": rng.choice((None, tensor(rng, n, channels, dtype=dtype))),
        "eps": 1e-5,
    }


def _residual_norm(rng: random.Random) -> Arguments:
    n, channels, dtype = _size(rng), rng.choice((1, 4, 33)), _dtype(rng)
    pairs = {
        name: tensor(rng, channels, dtype=dtype) for name in ("branch_norm_0", "branch_norm_1", "norm_0", "norm_1")
    }
    return {
        "x": tensor(rng, n, channels, dtype=dtype),
        "branch": tensor(rng, n, channels, dtype=dtype),
        "keep": rng.choice((None, tensor(rng, n, 1, dtype=dtype))),
        **pairs,
        "eps": 1e-5,
    }


def _call_residual_norm(a: Arguments):
    pairs = {name: (a[f"{name}_0"], a[f"{name}_1"]) for name in ("branch_norm", "norm")}
    return ops.residual_norm(a["x"], a["branch"], keep=a["keep"], **pairs, eps=a["eps"])


def _validate_state(rng: random.Random) -> Arguments:
    n, clouds, dtype = _size(rng), rng.choice((0, 1, 2, 3)), _dtype(rng)
    n = n if clouds else 0
    shapes = (n, 3), (n,), (n, *rng.choice(((), (2,), (0,), (2, 3))))
    previous = {f"previous[{f}]": tensor(rng, *shape, dtype=dtype) for f, shape in enumerate(shapes)}
    return {
        "fields[0]": tensor(rng, *shapes[0], dtype=dtype).abs(),
        "fields[1]": tensor(rng, *shapes[1], dtype=dtype).sigmoid(),
        "fields[2]": tensor(rng, *shapes[2], dtype=dtype),
        "bounds": ((-10.0, 10.0), (0.0, 1.0), (-9.0, 9.0)),
        "cu_rows": _offsets(rng, n, clouds),
        "cloud_scene": torch.arange(clouds) // 2,
        "origin": torch.zeros((clouds + 1) // 2, 3, dtype=torch.float64),
        "activity": torch.tensor([rng.randrange(3) for _ in range(n)], dtype=torch.uint8),
        "grid_size": rng.choice((0.0, 0.1)),
        "max_step": 1.0,
        "neutral": rng.choice((None, [0.0, 0.0, 1.0])),
        **rng.choice(({}, previous)),
    }


def _call_validate_state(a: Arguments):
    fields = [a[f"fields[{f}]"] for f in range(3)]
    previous = [a[f"previous[{f}]"] for f in range(3)] if "previous[0]" in a else None
    others = {name: value for name, value in a.items() if "[" not in name}
    found = ops.validate_state(fields, previous=previous, **others)
    awake = a["activity"] != ASLEEP  # who sleeps is not looked at
    if found.fields is None or not all(bool(field.isfinite().all()) for field in previous or ()):
        return found.status, found.record
    return found.status, found.record, *(field[awake] for field in found.fields)


def _join_records(rng: random.Random) -> Arguments:
    call = _validate_state(rng)
    fields, others = (
        [call[f"fields[{f}]"] for f in range(3)],
        ("bounds", "cu_rows", "cloud_scene", "origin", "activity"),
    )
    record = ops.validate_state(fields, **{name: call[name] for name in others}, join=False).record
    return {"parts": record.parts, "cu_rows": record.cu_rows, "n_rows": record.n_rows}


def _call_join_records(a: Arguments):
    shape = a["parts"].shape if isinstance(a["parts"], torch.Tensor) else ()
    joined = ops.join_records([ops.PartialRecord(a["parts"], a["cu_rows"], a["n_rows"], shape, torch.float64, None)])
    return joined if bool(a["parts"].isfinite().all()) else joined.shape  # parts beyond those in use have any numbers


def _norm_gelu(rng: random.Random) -> Arguments:
    channels, dtype = rng.choice((1, 4, 33)), _dtype(rng)
    columns = {name: tensor(rng, channels, dtype=dtype) for name in ("mean", "scale", "bias")}
    return {"x": tensor(rng, _size(rng), channels, dtype=dtype), **columns}


def _decode(rng: random.Random) -> Arguments:
    degree = rng.randrange(-1, 4)
    raw = tensor(rng, _size(rng), 3 * (degree + 1) ** 2 + 7, dtype=_dtype(rng))
    return {"raw": raw, "degree": rng.randint(-1, degree), "scale_min": 0.001, "scale_max": 0.1}


def _call_decode(a: Arguments):
    raw = a["raw"]
    wide = torch.float64 if isinstance(raw, Tensor) and raw.dtype == torch.float64 else torch.float32
    device = raw.device if isinstance(raw, Tensor) and not raw.is_meta else torch.device("cpu")
    return ops.decode_gaussians(**a, readings=readings(wide, device))


def _springs(rng: random.Random) -> Arguments:
    n, dtype = _size(rng), _dtype(rng)
    s = 2 * n
    neighbors = torch.tensor([rng.randrange(n) for _ in range(s)], dtype=torch.int64)
    lists = ops.SpringLists.from_neighbors(neighbors, _offsets(rng, s, n))._asdict()
    of_springs = {name: tensor(rng, s, dtype=dtype).abs() + 0.1 for name in ("lengths", "stiffness", "damping")}
    of_anchors = {name: tensor(rng, n, 3, dtype=dtype) for name in ("positions", "velocities", "external")}
    more = {"grip": tensor(rng, n, dtype=dtype).sigmoid(), "seconds": 0.1, "substeps": rng.choice((1, 2, 5))}
    return {**lists, **of_springs, **of_anchors, **more, "ground": rng.choice((None, 0.0)), "power": 0.5}


def _call_springs(a: Arguments):
    lists = ops.SpringLists(*(a[name] for name in ops.SpringLists._fields))
    out = ops.advance_springs(springs=lists, **{k: v for k, v in a.items() if k not in lists._fields})
    numbers = [x for x in a.values() if isinstance(x, Tensor) and x.is_floating_point() and x.numel()]
    tame = all(bool((x.abs() < 100).all()) for x in numbers) and bool((a["lengths"] > 1e-3).all()) and a["seconds"] < 1
    return out if tame and a["power"] < 2 else [x.shape for x in out]  # too long a substep gives any numbers


def _cameras(rng: random.Random, images: int) -> dict[str, Tensor]:
    viewmats = torch.eye(4).repeat(images, 1, 1)
    viewmats[:, :3, 3] = tensor(rng, images, 3, scale=0.1)
    viewmats[:, 2, 3] += 2
    K = torch.tensor([[10.0, 0.0, 5.0], [0.0, 11.0, 4.0], [0.0, 0.0, 1.0]])
    return {"viewmats": viewmats, "Ks": K.repeat(images, 1, 1)}


def _sources(rng: random.Random, images: int) -> dict[str, Tensor]:
    pairs = [[j for j in range(images) if rng.random() < 0.6] for _ in range(images)]
    return {
        "src_images": torch.tensor([j for own in pairs for j in own], dtype=torch.int64),
        "cu_src": torch.tensor([0, *(len(own) for own in pairs)]).cumsum(0),
    }


def _sweep_geometry(rng: random.Random) -> Arguments:
    images = rng.choice((0, 1, 2, 3))
    return {**_cameras(rng, images), **_sources(rng, images), "Ks_target": None}


def _plane_sweep(rng: random.Random) -> Arguments:
    geometry = {name: value for name, value in _sweep_geometry(rng).items() if name != "Ks_target"}
    homographies, translations = ops.sweep_geometry(**geometry)
    images, depths, dtype = len(geometry["Ks"]), rng.choice((1, 4)), _dtype(rng)
    return {
        "features": tensor(rng, images, rng.choice((1, 5)), rng.choice((1, 4)), rng.choice((1, 6)), dtype=dtype),
        "homographies": homographies.to(dtype),
        "translations": translations.to(dtype),
        "inverse_depths": tensor(rng, images, depths, dtype=dtype).abs() + 0.1,
        "src_images": geometry["src_images"],
        "cu_src": geometry["cu_src"],
    }


def _raster(rng: random.Random) -> Arguments:
    n, images, clouds, dtype = _size(rng), rng.choice((0, 1, 2)), rng.choice((1, 2)), _dtype(rng)
    degree = rng.choice((None, 0, 1, 3))
    return {
        "means": tensor(rng, n, 3, dtype=dtype, scale=0.5),
        "quats": tensor(rng, n, 4, dtype=dtype),
        "scales": tensor(rng, n, 3, dtype=dtype, scale=0.2).abs(),
        "opacities": tensor(rng, n, dtype=dtype).sigmoid(),
        **_cameras(rng, images),
        "near": torch.full((images,), 0.1),
        "far": torch.full((images,), 10.0),
        "image_cloud": torch.tensor([rng.randrange(clouds) for _ in range(images)], dtype=torch.int64),
        "width": rng.choice((1, 10, 17)),
        "height": rng.choice((1, 8)),
        "sh": None if degree is None else tensor(rng, n, (degree + 1) ** 2, 3, dtype=dtype, scale=0.3),
        "colors": tensor(rng, n, 3, dtype=dtype).sigmoid() if degree is None else None,
        "features": rng.choice((None, tensor(rng, n, 2, dtype=dtype))),
        "background": rng.choice((None, torch.ones(3, dtype=dtype))),
        "cu_rows": _offsets(rng, n, clouds),
        "near_plane": 0.01,
        "cutoff": rng.choice(("exact", "exact", "tile3sigma", "smooth")),
        "on_invalid": rng.choice(("raise", "raise", "drop", "clamp")),
    }


CAMERA = ("viewmats", "Ks", "near", "far", "image_cloud", "width", "height")


def _call_raster(a: Arguments):
    cameras = Cameras(**{name: a[name] for name in CAMERA})
    first = [a[name] for name in ("means", "quats", "scales", "opacities")]
    options = {
        name: value for name, value in a.items() if name not in (*CAMERA, "means", "quats", "scales", "opacities")
    }
    return tuple(ops.rasterize_gaussians(*first, cameras, **options))


def _projection(rng: random.Random) -> Arguments:
    taken = ("means", "quats", "scales", "opacities", *CAMERA, "cu_rows")
    return {name: value for name, value in _raster(rng).items() if name in taken}


def _call_projection(a: Arguments):
    cameras = Cameras(**{name: a[name] for name in CAMERA})
    rows = [a[name] for name in ("means", "quats", "scales")]
    pairs = ops.project_gaussians(*rows, cameras, opacities=a["opacities"], cu_rows=a["cu_rows"])
    return pairs.means2d, pairs.depths


def _projected(rng: random.Random) -> Arguments:
    n, dtype = _size(rng), _dtype(rng)
    images = 1 if dtype == torch.float64 else rng.choice((1, 2))  # images may get large, and double ones twice as large
    return {
        "means2d": tensor(rng, n, 2, dtype=dtype, scale=8),
        "conics": tensor(rng, n, 3, dtype=dtype).abs(),
        "depths": tensor(rng, n, dtype=dtype).abs() + 0.1,
        "opacities": tensor(rng, n, dtype=dtype).sigmoid(),
        "colors": tensor(rng, n, rng.choice((0, 1, 3, 5)), dtype=dtype),
        "width": rng.choice((1, 10, 17)),
        "height": rng.choice((1, 8)),
        "cu_pairs": _offsets(rng, n, images),
    }


def _harmonics(rng: random.Random) -> Arguments:
    n, dtype = _size(rng), _dtype(rng)
    terms = rng.choice((1, 4, 9, 16, 25))
    return {"directions": tensor(rng, n, 3, dtype=dtype), "sh": tensor(rng, n, terms, 3, dtype=dtype)}


# op -> (good arguments, the call)
OPS: dict[str, tuple[Callable[[random.Random], Arguments], Callable[[Arguments], Any]]] = {
    "curve_encode": (_curve_encode, lambda a: ops.curve_encode(**a)),
    "curve_sort": (_curve_sort, lambda a: ops.curve_sort(**a)),
    "build_pyramid": (_pyramid, _call_pyramid),
    "sparse_conv": (_sparse_conv, _call_sparse_conv),
    "patch_attention": (_patch_attention, _call_patch_attention),
    "joint_attention": (_joint_attention, _call_joint_attention),
    "row_scenes": (_row_scenes, _call_row_scenes),
    "find_cells": (_find_cells, lambda a: ops.find_cells(**a)),
    "add_cells": (_add_cells, lambda a: ops.add_cells(**a)),
    "overlapping_patches": (_overlapping_patches, lambda a: ops.overlapping_patches(**a)),
    "pool_max": (_pool, lambda a: ops.pool_max(**a)),
    "pool_mean": (_pool, lambda a: ops.pool_mean(**a)),
    "unpool": (_unpool, lambda a: ops.unpool(**a)),
    "segment_sum": (_segment, lambda a: ops.segment_sum(**a)),
    "segment_min": (_segment, lambda a: ops.segment_min(**a)),
    "segment_softmax": (_segment, lambda a: ops.segment_softmax(**a)),
    "row_norm": (_row_norm, lambda a: ops.row_norm(**a)),
    "residual_norm": (_residual_norm, _call_residual_norm),
    "validate_state": (_validate_state, _call_validate_state),
    "join_records": (_join_records, _call_join_records),
    "norm_gelu": (_norm_gelu, lambda a: ops.norm_gelu(**a)),
    "decode_gaussians": (_decode, _call_decode),
    "advance_springs": (_springs, _call_springs),
    "plane_sweep": (_plane_sweep, lambda a: ops.plane_sweep(**a)),
    "sweep_geometry": (_sweep_geometry, lambda a: ops.sweep_geometry(**a)),
    "rasterize_gaussians": (_raster, _call_raster),
    "project_gaussians": (_projection, _call_projection),
    "rasterize_projected": (_projected, lambda a: tuple(ops.rasterize_projected(**a)[:3])),
    "sh_to_color": (_harmonics, lambda a: ops.sh_to_color(**a)),
}


def _make(name: str, rng: random.Random, folder: Path) -> Arguments:
    arguments = OPS[name][0](rng)
    for argument in rng.sample(sorted(arguments), min(len(arguments), rng.choice((0, 1, 1, 1, 2, 3)))):
        arguments[argument] = mutate(arguments[argument], rng)
    return arguments


def _call(name: str, arguments: Arguments, folder: Path) -> None:
    """Forward and backward; both must be finite where no error comes."""
    _call_with(name, arguments, finite)


def _call_on_gpu(name: str, arguments: Arguments, folder: Path) -> None:
    """The same on a GPU, where numbers and index lists are not checked: of those that the CPU refuses a result may be
    anything, but images, which leave such rows out."""

    def check(value: Any, what: str = "result") -> None:
        try:
            finite(value, what)
        except Failure:
            if name == "rasterize_gaussians" or _cpu_takes(name, arguments):
                raise

    try:
        moved = {k: v.to("cuda") if isinstance(v, Tensor) and not v.is_meta else v for k, v in arguments.items()}
        try:
            _call_with(name, moved, check)
        finally:
            torch.cuda.synchronize()
    except RuntimeError as error:
        if "CUDA error" in str(error):  # the device can no longer be used by this process
            print(str(error).splitlines()[0], file=sys.stderr, flush=True)
            os._exit(1)
        raise


def _cpu_takes(name: str, arguments: Arguments) -> bool:
    try:
        _result(name, dict(arguments))
    except EXPECTED:
        return False
    return True


def _call_with(name: str, arguments: Arguments, check: Callable[..., None]) -> None:
    leaves = {}
    for argument, value in arguments.items():
        is_leaf = isinstance(value, Tensor) and value.is_floating_point() and value.layout == torch.strided
        leaves[argument] = value.detach().requires_grad_() if is_leaf else value
    result = _result(name, leaves)
    check(result)
    outputs = [t for t in _tensors(result) if t.requires_grad and not t.is_meta]
    if not outputs:
        return
    inputs = {name: t for name, t in leaves.items() if isinstance(t, Tensor) and t.requires_grad and not t.is_meta}
    g = torch.Generator().manual_seed(0)
    cotangents = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in outputs]
    grads = torch.autograd.grad(outputs, list(inputs.values()), cotangents, allow_unused=True)
    for (argument, value), grad in zip(inputs.items(), grads, strict=True):
        if grad is not None:
            check(grad, f"gradient of {argument}")
            if grad.shape != value.shape:
                raise Failure(f"gradient of {argument} has shape {list(grad.shape)}, not {list(value.shape)}")


def _result(name: str, leaves: Arguments) -> Any:
    """What the op returns; arguments whose gradient it refuses become plain numbers in ``leaves``."""
    for _ in leaves:
        try:
            return OPS[name][1](leaves)
        except GradientError as error:
            refused = [error.argument] if error.argument in leaves else list(leaves)
            plain = {key: leaves[key].detach() for key in refused if isinstance(leaves[key], Tensor)}
            leaves.update(plain)
    return OPS[name][1](leaves)


def _tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, (tuple, list)):
        return [t for item in value for t in _tensors(item)]
    return []


def _named(name: str, error: Exception, arguments: Arguments) -> bool:
    """Whether the message names an argument."""
    return any(argument in str(error) for argument in (*arguments, *STRUCTURES, "weight", "bias", "norm[0]", "norm[1]"))


def public_ops() -> set[str]:
    """Names of the functions that gsim3d.ops exports and that compute something."""
    return {name for name in ops.__all__ if inspect.isfunction(getattr(ops, name))} - {"cuda_compiled"}


TARGETS = [Target(name, partial(_make, name), partial(_call, name), EXPECTED, partial(_named, name)) for name in OPS]
TARGETS += [
    Target(
        f"{name}@cuda", partial(_make, name), partial(_call_on_gpu, name), EXPECTED, partial(_named, name), on_gpu=True
    )
    for name in OPS
]
