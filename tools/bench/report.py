#!/usr/bin/env python
"""Runs the benchmark of every op on the CPU and writes its numbers to docs/results/benchmarks.json.

    python tools/bench/report.py                  all ops
    python tools/bench/report.py raster pool      run these again, keep the other numbers

Let nothing else run meanwhile. Tables of these numbers, and of what tools/gpu_check.sh bench and
tools/bench/training.py measured on a GPU, are made when the documentation is built (docs/generate.py).
"""

import argparse
import datetime
import itertools
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import targets
from harness import RESULTS, commit

from gsim3d.io.machine import processor_name

ROOT = Path(__file__).resolve().parents[2]
GUARDS, EFFECTS, SLEEPING = "stability", "effects", "sleeping"
OPS = ["curve", "sparse_conv", "patch_attn", "pool", "row_norm", "plane_sweep", "raster", "decode", "background"]
OPS += ["springs", SLEEPING]
NUMBERS, STEPS = ROOT / "docs" / "results" / "benchmarks.json", RESULTS / "training.json"
GPU = """
## On a GPU

Medians of repeated calls between two events, as a program makes them: Python and launches included. "graph" is the same
call replayed from a CUDA graph, "-" where it cannot be captured. "limit" is what the chip's rates allow by a count of
bytes and operations; "wanted" is the ratio to the peer that we aim at.
"""
CPU = """
## On the CPU

float32. "torch" is the best form of the op in plain torch that we found (vectorised; the code is in
`tools/bench/<op>.py`). Medians of repeated runs; spread is the distance between the quartiles as a part of the median.
"faster" below 1 means that torch is faster.
"""

COSTS = """
### What guards cost

A rollout and an image with the default policy for invalid numbers ([stability](stability.md)) and without
any guard: processor time on one thread, both sides in turns; the cost is the median over pairs, with its quartiles.
"""


def number(value, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def rows_of(op: str) -> list[dict]:
    """What tools/gpu_check.sh bench measured."""
    file = RESULTS / f"{op}.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def of_one_run(row: dict) -> tuple[str, str, str, str]:
    return row["gpu"], row["torch"], row["commit"], row["date"]


def runs(rows: list[dict]):
    """(where and when, rows) of each run that ``rows``, in their order, are of."""
    for (gpu, torch, made_of, day), found in itertools.groupby(rows, of_one_run):
        yield f"{gpu}, torch {torch}, commit {made_of}, {day}", list(found)


def gpu_tables() -> str:
    ops = sorted(file.stem for file in RESULTS.glob("*.jsonl") if file.stem != EFFECTS)  # on a page of their own
    text = GPU + targets.table([row for op in ops for row in rows_of(op)]) if ops else ""
    for op in ops:
        rows = rows_of(op)
        text += f"\n### {op} on a GPU\n" if rows else ""
        for where, found in runs(rows):
            text += f"\n{where}.\n"
            text += cost_table([row for row in found if "cost" in row])
            text += peer_table([row for row in found if "cost" not in row])
    return text


def peer_table(rows: list[dict]) -> str:
    if not rows:
        return ""
    text = (
        "\n| case | dtype | gsim3d ms | graph | peer | peer ms | graph | ratio | wanted | limit ms | spread |\n"
        "| --- | --- | ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |\n"
    )
    for row in rows:
        ratio = "-" if row["peer_ms"] is None else f"{row['peer_ms'] / row['ours_ms']:.1f}x"
        wanted = "-" if row["target_ratio"] is None else f"{row['target_ratio']:g}x"
        text += (
            f"| {row['case']} | {row['dtype']} | {number(row['ours_ms'])} | {number(row['ours_graph_ms'])} "
            f"| {row['peer'] or '-'} | {number(row['peer_ms'])} | {number(row['peer_graph_ms'])} | {ratio} | {wanted} "
            f"| {number(row['limit_ms'])} | {row['spread']:.0%} |\n"
        )
    return text


def cost_table(rows: list[dict]) -> str:
    """Of what :meth:`Bench.cost` measured, on either device."""
    if not rows:
        return ""
    text = "\n| case | with ms | without ms | cost | quartiles | wanted |\n| --- | ---: | ---: | ---: | ---: | ---: |\n"
    for row in rows:
        low, high = row["quartiles"]
        wanted = "-" if row.get("limit") is None else f"{row['limit'] - 1:.0%}"
        both = (row["ours_ms"], row["peer_ms"]) if "ours_ms" in row else (row["gsim3d"]["ms"], row["plain"]["ms"])
        ms = " | ".join(f"{value:.2f}" for value in both)
        case = f"{row['case']}, {row['dtype']}" if "dtype" in row else row["case"]
        text += f"| {case} | {ms} | {row['cost']:.1%} | {low:.1%} to {high:.1%} | {wanted} |\n"
    return text


def processor() -> str:
    info = Path("/proc/cpuinfo")
    return processor_name() + (", AVX-512" if info.exists() and "avx512f" in info.read_text() else "")


def run(op: str) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "numbers.json"
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        subprocess.run([sys.executable, f"tools/bench/{op}.py", "--json", str(file)], cwd=ROOT, env=env, check=True)
        record = json.loads(file.read_text())
    today = datetime.date.today().isoformat()
    return {**record, "machine": processor(), "commit": commit(), "date": today, "python": platform.python_version()}


def page(records: dict[str, dict]) -> str:
    """The tables of all ops, as markdown."""
    text = gpu_tables() + CPU
    for op in OPS:
        if op not in records:
            continue
        r = records[op]
        text += (
            f"\n### {op}\n\n{r['machine']}, {r['threads']} threads, torch {r['torch']}, Python {r['python']}, "
            f"commit {r['commit']}, {r['date']}.\n\n"
            "| case | gsim3d ms | torch ms | faster | spread | error |\n| --- | ---: | ---: | ---: | ---: | ---: |\n"
        )
        for row in r["results"]:
            spread = max(row["gsim3d"]["spread"], row["torch"]["spread"])
            text += (
                f"| {row['case']} | {row['gsim3d']['ms']:.2f} | {row['torch']['ms']:.2f} | {row['faster']:.1f}x "
                f"| {spread:.0%} | {row['error']:.0e} |\n"
            )
    return text + costs(records[GUARDS]) if GUARDS in records else text


def costs(r: dict) -> str:
    where = f"{r['machine']}, torch {r['torch']}, Python {r['python']}, commit {r['commit']}, {r['date']}."
    return f"{COSTS}\n{where}\n{cost_table(r['results'])}"


def steps_table(rows: list[dict]) -> str:
    """What training.py measured, as a table."""
    if not rows:
        return "Not measured yet.\n"
    text = ""
    for where, found in runs(rows):
        text += f"{chr(10) if text else ''}{where}; medians.\n\n"
        text += "| case | processes | batch | particles a step | s a step | peak GiB | efficiency |\n"
        text += "| --- | ---: | ---: | ---: | ---: | ---: | ---: |\n"
        for row in sorted(found, key=lambda row: row["processes"]):
            efficiency = f"{row['efficiency']:.0%}" if row["efficiency"] else "-"
            text += (
                f"| {row['case']} | {row['processes']} | {row['batch']} | {row['particles']} | {row['seconds']:.2f} "
                f"| {row['gib']:.1f} | {efficiency} |\n"
            )
    return text


def effects(r: dict) -> str:
    """The tables of what effects cost."""
    where = f"{r['machine']}, one thread, torch {r['torch']}, Python {r['python']}, commit {r['commit']}, {r['date']}."
    on_gpu = "".join(f"\n{where}.\n{cost_table(found)}" for where, found in runs(rows_of(EFFECTS)))
    return f"{where}\n{cost_table(r['results'])}{on_gpu}"


def resting(rows: list[dict]) -> str:
    """The table of what rests: a step by its share, with a view and without, from a graph and in a call."""
    steps: dict[str, dict] = {}
    for row in rows:
        if found := re.fullmatch(r"(\d+) x \(step( \+ one 128 px view)?\), (\d+%) of .* rest", row["case"]):
            n, view = int(found[1]), bool(found[2])
            ours, awake = ([row[f"{side}_graph_ms"], row[f"{side}_ms"]] for side in ("ours", "peer"))
            for share, times in ((found[3], ours), ("0%", awake)):
                each = [None if ms is None else ms / n for ms in (*times, *awake)]
                steps.setdefault(share, {}).setdefault(view, []).append(each)
    if not steps:
        return ""
    text = f"\nCalls of {n} steps.\n\n| at rest | graph, ms a step | faster | call, ms a step | faster "
    text += "| with one 128 px view: graph | call | faster | steps a second |\n"
    text += "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n"
    medians = {share: {view: _medians(found) for view, found in views.items()} for share, views in steps.items()}
    for share in sorted(medians, key=lambda share: int(share[:-1])):
        graph, call, graph_awake, awake = medians[share][False]
        seen_graph, seen, _, seen_awake = medians[share][True]
        faster = "-" if graph is None else f"{graph_awake / graph:.2f}x"
        text += f"| {share} | {number(graph, 2)} | {faster} | {call:.2f} | {awake / call:.2f}x "
        text += f"| {number(seen_graph, 2)} | {seen:.2f} | {seen_awake / seen:.2f}x | {1e3 / seen:.0f} |\n"
    for row in rows:
        if row["case"].startswith("the background") and "90%" in medians:
            _, ms, _, awake = medians["90%"][False]
            text += f"\n{row['case'].capitalize()}: {row['ours_ms']:.1f} ms, once a rollout and as Python calls it; "
            text += f"at 90% it is saved again after {row['ours_ms'] / (awake - ms):.1f} captured steps.\n"
    return text


def _medians(rows: list[list[float | None]]) -> list[float | None]:
    """By column; of nothing at rest there are several rows."""
    return [None if None in values else statistics.median(values) for values in zip(*rows)]


def rest(rows: list[dict]) -> str:
    return "".join(f"{where}.\n{resting(found)}" for where, found in runs(rows)) or "Not measured yet.\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ops", nargs="*", choices=[[], *OPS, GUARDS, EFFECTS], help="default: all")
    args = parser.parse_args()
    records = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    for op in args.ops or [*OPS, GUARDS, EFFECTS]:
        records[op] = run(op)
        NUMBERS.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
