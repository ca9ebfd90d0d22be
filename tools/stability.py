#!/usr/bin/env python
"""Runs the hard cases and writes docs/stability.md (and docs/stability.json, the numbers behind it).

python tools/stability.py                   run all cases here: CPU, and CUDA where there is a GPU
python tools/stability.py --add FILE        add what another machine measured: stability.json of tools/gpu_check.sh, or
                                            GSIM3D_STABILITY_JSON=FILE pytest tests/stability
python tools/stability.py --costs FILE      add what guards cost: docs/benchmarks.json, or on a GPU
                                            tools/bench/results/stability.jsonl of tools/bench/stability.py
python tools/stability.py --page            only write the page again
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from tests.stability.cases import CASES, GROUPS  # noqa: E402
from tests.stability.constants import CONSTANTS  # noqa: E402
from tests.stability.setting import NAMES  # noqa: E402

NUMBERS, PAGE = ROOT / "docs" / "stability.json", ROOT / "docs" / "stability.md"
COSTS = ROOT / "docs" / "stability_costs.json"
GUARDS = ("guards", "guards_core")  # of tests/mutants
INTRODUCTION = """# Stability

Written by `python tools/stability.py` from the tests in `tests/stability`; do not edit.

**For every input, every op and the whole simulator either return finite outputs and finite gradients, or raise a typed
`gsim3d.NumericalError` that names scene, step, particle or camera and tensor, and says what to do. Never a silent NaN,
never an abort of the process, never a changed result for another member of the batch.**

What happens to a number that cannot be used is a policy, of a model or of a call: `on_invalid="raise"` (default),
`"drop"` or `"clamp"`; a `StabilityReport` counts what, where and how many. `gsim3d/numerics/policy.py` has the rules.

Every case below is a test that is named after it (`test_r01_...`), forward and backward. Most of them run beside an
ordinary scene in the same call, which must not notice: its rows have equal bits in float32 on the CPU, and everywhere
as long as the sizes of the call are the same. (In float64 and on a GPU, BLAS and cuDNN round by the number of rows or
images: rows in calls of different sizes are equal to rounding. That of TF32 is large, and torch lets convolutions use
it unless told otherwise; the encoder and training do only where matrix products may, too.)

Every policy is run over hostile frames, cameras, origins and particles, forward and backward
(`tests/stability/test_every_policy.py`). Where rows were dropped or clamped, a backward pass on the CPU raises
`NumericalError` where a gradient behind them is not finite. On a GPU gradients are not looked at, as that would
wait for it: the encoder refuses the frames that make such gradients there, too, and training skips steps that are not
finite.

Index lists that the CPU refuses are not looked at on a GPU, which would have to be waited for: entries out of range
take no part, nothing else is read or written, and rows that no entry names are 0.

The measured cells hold the largest error, relative to the largest expected value, against a float64 reference that
knows nothing of gsim3d, or against the same computation in float64 on the CPU; in brackets the bound that the test
sets. tf32: float32 with TF32 products allowed; bf16: under `torch.autocast`; the rasterizer, the geometry and the plane
sweep compute in float32 under both. "held": what is expected holds bit by bit, or as an error that is raised; there is
no number to compare.

What the published release does was seen on the CPU or read in its code; of other packages, public issues
(`name#number`), pull requests and commits are quoted.

"""


def cell(record: dict | None) -> str:
    if record is None:
        return "-"
    if record["failed"]:
        return "**fails**"
    if record["error"] is None:
        return "held"
    return f"{record['error']:.0e} ({record['bound']:.0e})"


def rows_of(columns: dict, group: str) -> str:
    text = (
        f"\n## {GROUPS[group]}\n\n| case | expected | {' | '.join(NAMES)} | others |\n"
        f"| --- | --- | {' | '.join('---' for _ in NAMES)} | --- |\n"
    )
    for case, what in CASES.items():
        if case[0] == group:
            text += f"| {case} {what.words} | {what.expected} | {measured(columns, case)} | {what.others or '-'} |\n"
    return text


def measured(columns: dict, case: str) -> str:
    """Its cells; a case of files has the same result everywhere."""
    host = columns.get("host", {}).get("cases", {}).get(case)
    return " | ".join(cell(host if host else columns.get(name, {}).get("cases", {}).get(case)) for name in NAMES)


def page(columns: dict) -> str:
    text = INTRODUCTION
    for name in [*NAMES, "host"]:
        if name in columns:
            column, what = columns[name], "files and their readers" if name == "host" else name
            n_cases, n_tests = len(column["cases"]), sum(record["tests"] for record in column["cases"].values())
            text += f"- {what}: {column['machine']}, torch {column['torch']}, {n_tests} tests of {n_cases} cases.\n"
    return text + "".join(rows_of(columns, group) for group in GROUPS) + costs() + bounds()


def bounds() -> str:
    """The constants that keep numbers bounded, and the guards with the tests that need them."""
    text = """
## Bounded insides

Between what goes in and what comes out these constants keep numbers bounded. Positions and everything of the
rasterizer are float32 or wider in every setting; sums are added in float32 or wider.

| constant | value | unit | consequence |
| --- | --- | --- | --- |
"""
    for c in CONSTANTS:
        text += f"| `{c.name}` ([{Path(c.file).name}](../{c.file})) | `{c.value}` | {c.unit} | {c.consequence} |\n"
    text += """
## Guards

Each guard is shown to matter: `python tools/mutants.py guards guards_core` takes them away one by one, and each time
the test beside it must fail.

| guard | in | test that fails without it |
| --- | --- | --- |
"""
    for name in GUARDS:
        for mutant in json.loads((ROOT / "tests" / "mutants" / f"{name}.json").read_text()):
            file, test = mutant["file"], mutant["test"].split("::")[1]
            text += f"| {mutant['guard']} | [{Path(file).name}](../{file}) | `{test}` |\n"
    return text


def costs() -> str:
    """What guards add to a step on each machine where that was measured."""
    rows = json.loads(COSTS.read_text())
    text = """
## What guards cost

A rollout of 4 steps with one image, or from a CUDA graph with 4, under the default policy and without any guard, both
in turns: processor time on one thread, or time between two events on a GPU. The cost is the median over pairs, with its
quartiles.

| machine | case | numbers | guarded ms | unguarded ms | cost | quartiles |
| --- | --- | --- | ---: | ---: | ---: | ---: |
"""
    for row in rows:
        low, high = row["quartiles"]
        text += (
            f"| {row['machine']}, torch {row['torch']} | {row['case']} | {row['dtype']} | {row['guarded_ms']:.2f} "
            f"| {row['unguarded_ms']:.2f} | {row['cost']:.1%} | {low:.1%} to {high:.1%} |\n"
        )
    return text


def with_costs(known: list[dict], file: Path) -> list[dict]:
    """``known`` rows, those of the same machine replaced by what ``file`` holds of tools/bench/stability.py."""
    if file.suffix == ".jsonl":
        rows = [row for line in file.read_text().splitlines() if "cost" in (row := json.loads(line))]
        rows = [
            {**row, "machine": row["gpu"], "guarded_ms": row["ours_ms"], "unguarded_ms": row["peer_ms"]} for row in rows
        ]
    else:
        record = json.loads(file.read_text())["stability"]
        times = ({"guarded_ms": row["gsim3d"]["ms"], "unguarded_ms": row["plain"]["ms"]} for row in record["results"])
        place = {"machine": record["machine"], "torch": record["torch"]}
        rows = [{"dtype": "float32", **row, **ms, **place} for row, ms in zip(record["results"], times)]
    names = ("machine", "torch", "case", "dtype", "guarded_ms", "unguarded_ms", "cost", "quartiles")
    rows = [{name: row[name] for name in names} for row in rows]
    machines = {row["machine"] for row in rows}
    return [row for row in known if row["machine"] not in machines] + rows


def add(columns: dict, measured: dict) -> dict:
    """What was measured replaces the same cases of the same columns."""
    merged = {name: {**column, "cases": dict(column["cases"])} for name, column in columns.items()}
    for name, column in measured.items():
        known = merged.get(name, {"cases": {}})["cases"]
        merged[name] = {**column, "cases": dict(sorted({**known, **column["cases"]}.items()))}
    return merged


def run() -> dict:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stability.json"
        env = {**os.environ, "PYTHONPATH": str(ROOT), "GSIM3D_STABILITY_JSON": str(file)}
        subprocess.run([sys.executable, "-m", "pytest", "tests/stability"], cwd=ROOT, env=env, check=True)
        return json.loads(file.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--add", metavar="FILE", help="run nothing, add these results")
    parser.add_argument("--costs", metavar="FILE", type=Path, help="run nothing, add what guards cost")
    parser.add_argument("--page", action="store_true", help="run nothing, write the page from the stored numbers")
    args = parser.parse_args()
    columns = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    if args.costs:
        known = json.loads(COSTS.read_text()) if COSTS.exists() else []
        COSTS.write_text(json.dumps(with_costs(known, args.costs), indent=1) + "\n")
    elif not args.page:
        columns = add(columns, json.loads(Path(args.add).read_text()) if args.add else run())
        NUMBERS.write_text(json.dumps(columns, indent=1, sort_keys=True) + "\n")
    PAGE.write_text(page(columns))


if __name__ == "__main__":
    main()
