"""The documentation builds without warnings, covers every public name, and names nothing that does not exist."""

import importlib
import inspect
import os
import re
import shlex
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

import gsim3d
from gsim3d import ops
from gsim3d.cli.arguments import Parser
from gsim3d.cli.main import COMMANDS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
MOST_LINES = 120
NOT_PAGES = {"notes", "_build", "_generated"}
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.relative_to(DOCS).parts[0] not in NOT_PAGES]
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
RUNNABLE = [
    page for page in PAGES if "```python\n" in page.read_text() and page.parent.name in ("tutorials", "concepts")
]
RESULTS_OF_COMMANDS = ("runs/", "DIR")


def ids(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_pages_build_without_warnings_and_cover_every_public_name():
    for module in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(module)
    built = DOCS / "_build"
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-E", "-q", str(DOCS), str(built)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    content = (built / "objects.inv").read_bytes().split(b"\n", 4)[4]
    documented = {line.split()[0] for line in zlib.decompress(content).decode().splitlines()}
    public = {name for name in gsim3d.__all__ if name[0] != "_" and not inspect.ismodule(getattr(gsim3d, name))}
    missing = {name for name in public - set(ops.__all__) if f"gsim3d.{name}" not in documented}
    missing |= {name for name in ops.__all__ if f"gsim3d.ops.{name}" not in documented}
    assert not missing


@pytest.mark.parametrize("page", RUNNABLE, ids=ids)
def test_code_of_page_runs(page, tmp_path):
    code = "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", TEXTS, ids=ids)
def test_paths_exist(page):
    text = page.read_text()
    named = re.findall(r"`((?:csrc|gsim3d|tests|tools|docs|configs|examples)/[^`\s]*)`", text)
    missing = [name for name in named if "<" not in name and not any(map(_exists, _alternatives(name)))]
    linked = [link for link in re.findall(r"\]\(([^)#:\s]+)", text) if not (page.parent / link).exists()]
    linked += [file for file in re.findall(r"literalinclude\} (\S+)", text) if not (page.parent / file).is_file()]
    assert not [*missing, *linked]


def _alternatives(name: str) -> list[str]:
    """``a/{b,c}.d`` as two names."""
    if not (found := re.match(r"(.*)\{(.*)\}(.*)", name)):
        return [name]
    return [f"{found[1]}{part}{found[3]}" for part in found[2].split(",")]


def _exists(name: str) -> bool:
    return bool(list(ROOT.glob(name.rstrip("/")))) or name.startswith(("docs/_build", "docs/_generated"))


@pytest.mark.parametrize("page", TEXTS, ids=ids)
def test_python_names_exist(page):
    names = set(re.findall(r"(?<![\w./\[-])gsim3d(?:\.[A-Za-z_]\w*)+", page.read_text()))
    missing = [name for name in names if not _resolves(name.removesuffix(".sh").removesuffix(".py"))]
    assert not missing


def _resolves(name: str) -> bool:
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:n]))
        except ImportError:
            continue
        for part in parts[n:]:
            if not hasattr(value, part):
                return part in getattr(value, "__dataclass_fields__", ())
            value = getattr(value, part)
        return True
    return False


def commands(page: Path) -> list[str]:
    """Lines that begin with gsim3d, and those of torchrun, with their continuations, without placeholders."""
    found = []
    for block in re.findall(r"```(?:text|bash)\n(.*?)```", page.read_text(), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            line = line.partition("  #")[0].strip()
            if line.startswith(("gsim3d ", "python -m gsim3d ", "torchrun ")) and "gsim3d " in line and "[" not in line:
                found.append(line[line.index("gsim3d ") :])
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=ids)
def test_commands_parse(page):
    for line in commands(page):
        words = shlex.split(line, comments=True)[1:]
        words = words[: words.index(">")] if ">" in words else words
        if words[0] == "COMMAND":
            continue
        parser = Parser(prog=f"gsim3d {words[0]}")
        importlib.import_module(COMMANDS[words[0]][0]).add_arguments(parser)
        parser.parsed(words[1:])


def test_data_sets_of_one_folder_are_the_same():
    texts = [page.read_text() for page in (*TEXTS, *ROOT.glob("examples/*.py"))]
    made = re.findall(r"^(gsim3d generate .*--out (\S+))", "\n".join(texts), re.MULTILINE)
    commands = {folder: {command for command, named in made if named == folder} for _, folder in made}
    assert len(commands) > 2 and not [several for several in commands.values() if len(several) > 1]


def test_map_of_the_repository_is_complete():
    page = (DOCS / "contributing" / "architecture.md").read_text()
    named = set(re.findall(r"^ *(\S+?)/? {2,}\S", page.split("```text\n")[1].split("```")[0], re.MULTILINE))
    for folder in ("csrc/gsim3d", "gsim3d"):
        for path in (ROOT / folder).iterdir():
            if not path.name.startswith(("__pycache__", "_ops", "_core")):
                assert path.name in named, f"architecture.md does not name {folder}/{path.name}"


@pytest.mark.parametrize("file", ["README.md", "CONTRIBUTING.md"])
def test_text_is_short(file):  # tools/sizes.py counts the words of all pages
    assert len((ROOT / file).read_text().splitlines()) <= MOST_LINES


def test_figures_are_small():
    for picture in [*(DOCS / "figures").glob("*.svg"), *(DOCS / "figures").glob("*.png")]:
        assert picture.stat().st_size < 100_000, picture


def test_pages_that_code_names_exist():
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    code = [ROOT / file for file in files if file.endswith((".py", ".sh", ".yaml", ".yml", ".toml", ".cpp", ".h"))]
    named = {name for file in code if file.is_file() for name in re.findall(r"docs/[\w/.-]+\.md", file.read_text())}
    assert not [name for name in named if not (ROOT / name).is_file()]
