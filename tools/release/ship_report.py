#!/usr/bin/env python
"""Puts reports of accuracy against time of a trained simulator into the documentation, its speeds into the package.

    gsim3d profile elastic-small DATA --scenes all --out runs/cpu                  # on 2 CPU cores
    gsim3d profile elastic-small DATA --scenes all --device cuda --out runs/h200
    python tools/release/ship_report.py elastic-small cpu=runs/cpu h200=runs/h200

Every DIR holds report.json and the pictures, and speeds.json where `gsim3d profile` could not write beside the
checkpoint. Written: docs/results/cost/NAME-MACHINE.json and its pictures, of which the documentation makes a page;
NAME's speeds.json for `gsim3d simulate --speed`.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d import pretrained  # noqa: E402
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.report import write_json  # noqa: E402
from gsim3d.numerics.speed import SPEEDS_FILE  # noqa: E402
from gsim3d.profile.report import share_in_words, throughput_in_words  # noqa: E402

COST = ROOT / "docs" / "results" / "cost"
PICTURES = {"cost.png": "cost.png", "stages.png": "sections.png", "horizon.png": "horizon.png"}
FACTS = ("scenes", "steps", "image")


def keep_report(name: str, machine: str, folder: Path, cost: Path = COST) -> Path:
    """Copies what the documentation shows of a report, and its pictures, into the folder ``cost``."""
    content = json.loads((folder / "report.json").read_text())
    for picture, source in PICTURES.items():
        shutil.copyfile(folder / source, cost / f"{name}-{machine}-{picture}")
    facts = {**content["machine"], **{key: content["case"][key] for key in FACTS}}
    file = cost / f"{name}-{machine}.json"
    shown = {
        "device": content["machine"]["device"],
        "checkpoint": content["case"]["checkpoint"],
        "command": content["command"],
        "measured_on": ", ".join(f"{key} {value}" for key, value in facts.items()),
        "throughput": throughput_in_words(content),
        "rows": [row_of(point) for point in content["settings"]],
    }
    file.write_text(json.dumps(shown, indent=1) + "\n")
    return file


def row_of(point: dict) -> list[str]:
    """Number, setting, kind, step ms, p95, encode ms, speed-up, agreement dB, masked PSNR dB, share of the gain."""
    start = [str(point["number"]), point["name"], point["kind"]]
    if "failure" in point:
        return [*start, f"failed: {point['failure']}", *[""] * 6]
    step, faster = point["step_ms"], "tie" if point["tie_with_reference"] else f"{point['faster']:.2f}"
    psnr = point["task"].get("psnr_masked", point["task"]["psnr"])
    numbers = (f"{step['median']:.2f}", f"{step['p95']:.2f}", f"{point['encode_ms']['median']:.1f}", faster)
    return [*start, *numbers, f"{point['agreement']['psnr']:.1f}", f"{psnr:.2f}", share_in_words(point["kept"])]


def keep_speeds(folder: Path, reports: dict[str, Path]) -> Path:
    """What all reports tuned, in one file beside the weights."""
    file = folder / SPEEDS_FILE
    known = json.loads(file.read_text()) if file.is_file() else {}
    for report in reports.values():
        if (report / SPEEDS_FILE).is_file():
            for digest, devices in json.loads((report / SPEEDS_FILE).read_text()).items():
                known[digest] = {**known.get(digest, {}), **devices}
    write_json(file, known)
    return file


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="such as elastic-small")
    parser.add_argument("reports", nargs="+", metavar="MACHINE=DIR", help="what gsim3d profile wrote, by machine")
    args = parser.parse_args(arguments)
    reports = {}
    for given in args.reports:
        machine, _, folder = given.partition("=")
        if not (Path(folder) / "report.json").is_file():
            raise InputError(f"{given}: must be MACHINE=DIR, and DIR hold report.json")
        reports[machine] = Path(folder)
    files = [keep_report(args.name, machine, folder) for machine, folder in reports.items()]
    print(f"written: {', '.join(map(str, (*files, keep_speeds(pretrained.FOLDER / args.name, reports))))}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"ship_report: error: {error}")
