"""docs/results/accuracy_vs_time.md has every knob and every row as they are declared."""

from pathlib import Path

from gsim3d.ablate.rows import ROWS
from gsim3d.profile.settings import KNOBS

PAGE = Path(__file__).parents[2] / "docs" / "results" / "accuracy_vs_time.md"


def table(*rows: tuple[str, ...]) -> str:
    head, *rest = rows
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ("---",) * len(head), *rest))


def knobs_table() -> str:
    return table(("knob", "kind", "needs"), *((knob.name, knob.kind, knob.needs or "-") for knob in KNOBS))


def rows_table() -> str:
    rows = ((f"`{row.name}`", row.differs, row.paper or "-") for row in ROWS.values())
    return table(("row", "what differs", "paper"), *rows)


def test_the_knobs_are_those_declared():
    assert knobs_table() in PAGE.read_text(), f"write into {PAGE.name}:\n{knobs_table()}"


def test_the_rows_are_those_declared():
    assert rows_table() in PAGE.read_text(), f"write into {PAGE.name}:\n{rows_table()}"
