#!/usr/bin/env python
"""Puts reports of accuracy against time of a trained simulator into the documentation, its speeds into the package.

    gsim3d profile elastic-small --out runs/cpu                                    # on 2 CPU cores
    gsim3d profile elastic-small DATA --scenes all --device cuda --self-check --out runs/h200
    python tools/ship_report.py elastic-small cpu=runs/cpu h200=runs/h200

Every DIR holds report.json and the pictures, and speeds.json where `gsim3d profile` could not write beside the
checkpoint. Written: docs/cost-NAME.md and its pictures, where reports of other machines stay, marked if they are of
other weights; NAME's speeds.json for `gsim3d simulate --speed`.
"""

import argparse
import json
import re
import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d import pretrained  # noqa: E402
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.report import write_json  # noqa: E402
from gsim3d.profile.autotune import SPEEDS  # noqa: E402
from gsim3d.profile.page import share_in_words  # noqa: E402
from gsim3d.profile.report import regimes_in_words  # noqa: E402

DOCS = ROOT / "docs"
PICTURES = ("cost.png", "stages.png", "horizon.png")
OTHER_WEIGHTS = "Of weights that this simulator had before those in the package."
INTRO = """# What the accuracy of {name} costs

Written by `python tools/ship_report.py`; do not edit. How to read it: [accuracy-time.md](accuracy-time.md); what the
simulator is: [trained.md](trained.md). Every number can be made again by the command printed under it.
"""


def write_page(name: str, reports: dict[str, Path], docs: Path = DOCS) -> Path:
    """docs/cost-NAME.md of reports by the names of their machines."""
    page = docs / f"cost-{name}.md"
    parts, checkpoints = [INTRO.format(name=name)], []
    for machine, folder in reports.items():
        content = json.loads((folder / "report.json").read_text())
        for picture in PICTURES:
            shutil.copyfile(folder / picture, docs / f"cost-{name}-{machine}-{picture}")
        parts.append(section(name, machine, content))
        checkpoints.append(content["subject"]["checkpoint"])
    parts += other_sections(name, page, reports, checkpoints)
    page.write_text("\n".join(parts))
    return page


def other_sections(name: str, page: Path, reports: Iterable[str], checkpoints: Sequence[str]) -> list[str]:
    """What ``page`` says of machines that have no new report."""
    kept = []
    for part in page.read_text().split("\n## ")[1:] if page.is_file() else ():
        if re.search(rf"\(cost-{name}-(\w+)-cost\.png\)", part)[1] in reports:
            continue
        heading, rest = part.split("\n", 1)
        if OTHER_WEIGHTS not in rest and not any(f"checkpoint {digest}" in rest for digest in checkpoints):
            rest = f"\n{OTHER_WEIGHTS}\n{rest}"
        kept.append(f"## {heading}\n{rest}")
    return kept


def section(name: str, machine: str, content: dict) -> str:
    """One report."""
    shown = {picture: f"cost-{name}-{machine}-{picture}" for picture in PICTURES}
    facts = {
        **content["machine"],
        **{key: content["subject"][key] for key in ("checkpoint", "scenes", "steps", "image")},
    }
    checks = "".join(f"- {check}\n" for check in content["self_check"])
    return f"""## {content["machine"]["device"]}

![What 99.9 % and 99 % of the gain cost]({shown["cost.png"]})

{table(content)}

{"".join(f"- {line}" + chr(10) for line in regimes_in_words(content["regimes"]))}
Made by `{content["command"]}`; {", ".join(f"{key} {value}" for key, value in facts.items())}.

Not turned: {"; ".join(f"{knob}: {why}" for knob, why in content["not_turned"].items())}.

{"The timing's own check:" + 2 * chr(10) + checks if checks else "Without a check of the timing."}

![Where the time of a step goes]({shown["stages.png"]})

![How the error grows with the horizon]({shown["horizon.png"]})
"""


def table(content: dict) -> str:
    """A row for each setting."""
    lines = [
        "| # | setting | kind | step ms | p95 | encode ms | faster | agreement dB | masked PSNR dB | gain kept |",
        "| ---: | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in content["points"]:
        start = f"| {row['number']} | {row['name']} | {row['kind']} |"
        if "failure" in row:
            lines.append(f"{start} failed: {row['failure']} | | | | | | |")
            continue
        step, faster = row["step_ms"], "tie" if row["tie_with_reference"] else f"{row['faster']:.2f}"
        psnr = row["task"].get("psnr_masked", row["task"]["psnr"])
        numbers = (f"{step['median']:.2f}", f"{step['p95']:.2f}", f"{row['encode_ms']['median']:.1f}", faster)
        errors = (f"{row['agreement']['psnr']:.1f}", f"{psnr:.2f}", share_in_words(row["kept"]))
        lines.append(f"{start} {' | '.join((*numbers, *errors))} |")
    return "\n".join(lines)


def keep_speeds(folder: Path, reports: dict[str, Path]) -> Path:
    """What all reports tuned, in one file beside the weights."""
    file = folder / SPEEDS
    known = json.loads(file.read_text()) if file.is_file() else {}
    for report in reports.values():
        if (report / SPEEDS).is_file():
            for digest, devices in json.loads((report / SPEEDS).read_text()).items():
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
    print(f"written: {write_page(args.name, reports)}, {keep_speeds(pretrained.FOLDER / args.name, reports)}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"ship_report: error: {error}")
