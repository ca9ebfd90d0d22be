"""Prints the sizes of the repository beside their limits; the exit code is 1 where one is exceeded.

python tools/sizes.py
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "gsim3d"
LIBRARY = ("ops", "nn", "dynamics", "priors", "effects", "numerics", "math", "pretrained")  # folders of the inner ring
FORMATS = ("io", "viewer")
# Of the package: its core, readers and viewer, kernels of other projects' users, actions and planning.
PACKAGE_LIMIT = 22_500 + 2_200 + 900 + 1_800


class Size(NamedTuple):
    """One size and its limit."""

    what: str  #: what is counted
    value: int  #: how many
    limit: int  #: the largest value that is allowed
    where: str = ""  #: where the largest one is; empty where all are counted together

    @property
    def holds(self) -> bool:
        return self.value <= self.limit

    def __str__(self) -> str:
        mark = "ok  " if self.holds else "OVER"
        return f"{mark} {self.what:<52} {self.value:>7,} of {self.limit:>7,}  {self.where}".rstrip()


def sizes() -> list[Size]:
    """All sizes."""
    library = [*_python(*(PACKAGE / name for name in LIBRARY)), *PACKAGE.glob("*.py")]
    longest, where = max(
        (lines, f"{path.relative_to(ROOT)}:{name}") for path in library for name, lines in _functions(path)
    )
    apart = {"notes", "_build", "_generated"}
    pages = [page for page in (ROOT / "docs").rglob("*.md") if apart.isdisjoint(page.parts)]
    pages += [page for page in ROOT.glob("*.md") if page.name != "CHANGELOG.md"]
    words = sum(len(page.read_text().split()) for page in pages)
    forward = dict(_functions(PACKAGE / "dynamics" / "model.py")).get("Dynamics.forward", 0)
    return [
        Size("lines of the package", _lines(_python(PACKAGE)), PACKAGE_LIMIT),
        Size("lines of the library without io", _lines(library), 10_000),
        Size("lines of readers, writers and the viewer", _lines(_python(*(PACKAGE / name for name in FORMATS))), 2_800),
        Size("lines of gsim3d/profile", _lines(_python(PACKAGE / "profile")), 1_600),
        Size("lines of tools", _lines(_python(ROOT / "tools")), 5_500),
        Size("lines of the longest function of the library", longest, 60, where),
        Size("lines of Dynamics.forward", forward, 30),
        Size("words of documentation without notes and CHANGELOG", words, 25_000),
        Size("lines of README.md", len((ROOT / "README.md").read_text().splitlines()), 120),
    ]


def _python(*folders: Path) -> list[Path]:
    return sorted(path for folder in folders for path in folder.rglob("*.py"))


def _lines(paths: list[Path]) -> int:
    return sum(len(path.read_text().splitlines()) for path in paths)


def _functions(path: Path) -> Iterator[tuple[str, int]]:
    """(qualified name, lines of code without the docstring) of every function of a file."""

    def visit(node: ast.AST, prefix: str) -> Iterator[tuple[str, int]]:
        for child in ast.iter_child_nodes(node):
            name = f"{prefix}{getattr(child, 'name', '')}"
            if isinstance(child, ast.ClassDef):
                yield from visit(child, f"{name}.")
            elif isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
                first = child.body[0]
                has_docstring = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
                documented = first.end_lineno - first.lineno + 1 if has_docstring else 0
                yield name, child.end_lineno - child.lineno + 1 - documented
                yield from visit(child, f"{name}.")
            else:
                yield from visit(child, prefix)

    yield from visit(ast.parse(path.read_text()), "")


def main() -> int:
    found = sizes()
    print("\n".join(map(str, found)))
    return 0 if all(size.holds for size in found) else 1


if __name__ == "__main__":
    sys.exit(main())
