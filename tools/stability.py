#!/usr/bin/env python
"""Runs the hard cases and writes their numbers to docs/results/stability.json.

python tools/stability.py                   run all cases here: CPU, and CUDA where there is a GPU
python tools/stability.py --add FILE        add what another machine measured: stability.json of tools/gpu_check.sh, or
                                            GSIM3D_STABILITY_JSON=FILE pytest tests/stability
python tools/stability.py --costs FILE      add what guards cost: docs/results/benchmarks.json, or on a GPU
                                            tools/bench/results/stability.jsonl of tools/bench/stability.py

The tables of these numbers are made when the documentation is built (docs/generate.py).
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

NUMBERS, COSTS = (ROOT / "docs" / "results" / f"{name}.json" for name in ("stability", "stability_costs"))
GUARDS = ("guards", "guards_core")  # of tests/mutants


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
    """The tables of all cases, constants and guards, as markdown."""
    text = ""
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
        text += f"| `{c.name}` (`{c.file}`) | `{c.value}` | {c.unit} | {c.consequence} |\n"
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
            text += f"| {mutant['guard']} | `{file}` | `{test}` |\n"
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
    args = parser.parse_args()
    columns = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    if args.costs:
        known = json.loads(COSTS.read_text()) if COSTS.exists() else []
        COSTS.write_text(json.dumps(with_costs(known, args.costs), indent=1) + "\n")
    else:
        columns = add(columns, json.loads(Path(args.add).read_text()) if args.add else run())
        NUMBERS.write_text(json.dumps(columns, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
