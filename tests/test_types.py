"""The public API is typed: signatures are complete, and mypy accepts a use of it."""

import ast
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

import gsim3d

ROOT = Path(__file__).parent.parent
CHECKED = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"]["files"]


def files():
    paths = [
        path for name in CHECKED for path in ([ROOT / name] if name.endswith(".py") else (ROOT / name).glob("*.py"))
    ]
    assert all(path.is_file() for path in paths)
    return [path for path in paths if not path.name.startswith("_") or path.name == "__init__.py"]


def test_names_for_type_checkers_are_the_lazy_ones():
    tree = ast.parse((ROOT / "gsim3d" / "__init__.py").read_text())
    imports = [node for block in tree.body if isinstance(block, ast.If) for node in block.body]
    found = {alias.asname: node.module for node in imports for alias in node.names}
    found |= dict.fromkeys(gsim3d.ops.__all__, found.pop(None))  # import *
    assert found == gsim3d._MODULE_OF


def untyped(path):
    """Parameters and results of public functions of a file that have no annotation."""
    tree = ast.parse(path.read_text())
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    bodies = [tree.body, *(node.body for node in classes)]
    for function in (node for body in bodies for node in body if isinstance(node, ast.FunctionDef)):
        if function.name.startswith("_"):
            continue
        given = function.args
        arguments = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
        names = [a.arg for a in arguments if a and a.annotation is None and a.arg not in ("self", "cls")]
        names += ["its result"] if function.returns is None else []
        yield from (f"{path.relative_to(ROOT)}: {function.name}: {name}" for name in names)


def test_public_signatures_are_typed():
    missing = [line for path in files() for line in untyped(path)]
    assert not missing, "without a type:\n" + "\n".join(missing)


@pytest.mark.skipif(find_spec("mypy") is None, reason="needs mypy")
def test_mypy(tmp_path):
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
