"""The times that the kernels and the whole model aim at on one H200, and what was measured of them.

A row may name several cases (forward, and forward and backward): it is held where all of them are.
"""

import re

BOTH = ("fwd", "fwd+bwd")
DYNAMICS = ("fwd, captured", "fwd+bwd, captured")
FROM_GRAPHS = "layer norms, simulated steps captured"  # how gsim3d trains on a GPU (`captured: true`)
# (op, case, parts of it, dtype, wanted ms of each part)
TARGETS = (
    ("raster", "4 x 9 views, 128 px, 65k, SH0", ("fwd",), "float32", (0.28,)),
    ("raster", "4 x 9 views, 128 px, 65k, SH0", ("fwd+bwd",), "float32", (0.70,)),
    ("raster", "48 x 9 views, 128 px, 65k, SH0", ("fwd+bwd",), "float32", (6.0,)),
    ("raster", "4 x 9 views, 256 px, 262k, SH3", ("fwd+bwd",), "float32", (2.9,)),
    ("raster", "1 view, 1080p, 1M, SH0", BOTH, "float32", (0.7, 2.0)),
    ("patch_attn", "64k rows, 1024 a patch, 4 heads of 16", BOTH, "bfloat16", (0.10, 0.38)),
    ("patch_attn", "64k rows, 1024 a patch, 32 heads of 16", BOTH, "bfloat16", (0.80, 2.9)),
    ("sparse_conv", "64k x 64, 1.9 neighbours", BOTH, "float16", (0.04, 0.12)),
    ("sparse_conv", "256k x 128, 10.0 neighbours", BOTH, "float16", (0.45, 1.2)),
    ("sparse_conv", "16k x 512, 10.0 neighbours", BOTH, "float16", (0.40, 1.1)),
    ("curve", "4 codes and their sorts, 256k points", (), "int64", (0.15,)),
    ("plane_sweep", "4 scenes x 4 views, 32x32x128, D=64", BOTH, "float32", (0.1, 0.4)),
    ("plane_sweep", "4 scenes x 4 views, 64x64x128, D=64", BOTH, "float32", (0.7, 2.4)),
    ("pool", "max, 256k x 64 rows to 64325", ("fwd+bwd",), "float32", (0.15,)),
    ("end_to_end", "dynamics T=4, 65k points a step", DYNAMICS, "bfloat16", (15.0, 50.0)),
    ("end_to_end", "dynamics T=2, 65k points a step", DYNAMICS, "bfloat16", (10.0, 35.0)),
    ("end_to_end", "dynamics T=4, 16k masked points a step", DYNAMICS, "bfloat16", (4.0, 12.0)),
    ("end_to_end", "dynamics T=2, 16k masked points a step", DYNAMICS, "bfloat16", (3.0, 9.0)),
    ("end_to_end", f"training step 4-1-12, batch 4, masked, {FROM_GRAPHS}", (), "bfloat16", (1000.0,)),
)
INTRODUCTION = """
### Targets

Times of an op from a CUDA graph, "called" with Python and launches, which the ratio to the fastest peer of the run
includes; the dynamics from a graph against the authors' release, recorded once with launches; the training step as
`captured: true` runs it, against the time that the paper gives (launched kernel by kernel, with the release's batch
norms, it waits for the host). A row is held where each of its times is.
"""


def without_memory(case: str) -> str:
    return re.sub(r", [0-9.]+ GiB", "", case)


def measured(rows: list[dict]) -> list[dict]:
    """A record for each target: its row of the table, and by how much the worst of its times misses."""
    known = {(row["op"], without_memory(row["case"]), row["dtype"]): row for row in rows}
    found = []
    for op, case, parts, dtype, wanted in TARGETS:
        names = [f"{case}: {part}" for part in parts] or [case]
        cells = [known[op, name, dtype] for name in names if (op, name, dtype) in known]
        if len(cells) == len(names):
            times = [row["ours_graph_ms"] or row["ours_ms"] for row in cells]
            missed = max(ms / most for ms, most in zip(times, wanted)) - 1
            found.append({"name": f"{case}: {' / '.join(parts)}" if parts else case, "op": op, "cells": cells,
                          "wanted": wanted, "times": times, "missed": missed})  # fmt: skip
    return found


def together(values, form: str = ".3g") -> str:
    return " / ".join(f"{value:{form}}" for value in values)


def table(rows: list[dict]) -> str:
    found = measured(rows)
    if not found:
        return ""
    text = INTRODUCTION + (
        "\n| case | op | wanted ms | graph ms | called ms | ratio, called | commit | held |\n"
        "| --- | --- | ---: | ---: | ---: | ---: | --- | --- |\n"
    )
    for record in found:
        cells = record["cells"]
        graphs = " / ".join("-" if row["ours_graph_ms"] is None else f"{row['ours_graph_ms']:.3f}" for row in cells)
        captured = "captured" in record["name"]
        calls = [row["ours_ms"] for row in cells]
        ratios = together((row["peer_ms"] / row["ours_ms"] for row in cells), ".1f")
        held = "yes" if record["missed"] <= 0 else f"misses by {record['missed']:.1%}"
        text += (
            f"| {record['name']} | {record['op']} | {together(record['wanted'], 'g')} "
            f"| {together(calls, '.3f') if captured else graphs} | {'-' if captured else together(calls, '.3f')} "
            f"| {ratios}x | {' / '.join(sorted({row['commit'] for row in cells}))} | {held} |\n"
        )
    held = sum(record["missed"] <= 0 for record in found)
    return f"{text}\n{held} of {len(found)} are held.\n"
