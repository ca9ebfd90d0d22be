"""README stays true: its commands, ops and snippets exist and run. Links and names: test_docs.py."""

import importlib
import inspect
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gsim3d.cli.arguments import Parser
from gsim3d.cli.main import COMMANDS
from gsim3d.pretrained import located
from gsim3d.synth.worlds import build_world

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands() -> list[list[str]]:
    found = []
    for block in blocks("bash"):
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            while words and "=" in words[0] and not words[0].startswith("-"):
                words = words[1:]
            if words:
                found.append(words)
    return found


def test_the_two_commands_come_first():
    assert commands()[:2] == [["bash", "tools/demo.sh"], ["bash", "tools/test.sh"]]


def assert_parses(arguments: list[str]) -> None:
    """Command, options and their values are taken; worlds, presets, sets and shipped simulators exist."""
    if ">" in arguments:
        arguments = arguments[: arguments.index(">")]
    module = importlib.import_module(COMMANDS[arguments[0]][0])
    parser = Parser(prog=f"gsim3d {arguments[0]}")
    module.add_arguments(parser)
    args = parser.parsed(arguments[1:])
    if arguments[0] == "generate":
        build_world(args.world, args.preset, {})
    for word in arguments[1:]:
        if word.endswith("-small"):
            located(word)


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_command_exists(words):
    if words[0] == "bash" or words[0] == "python" and words[1] != "-m":
        assert (ROOT / words[1]).is_file()
    elif words[0] == "gsim3d" or words[:3] == ["python", "-m", "gsim3d"]:
        arguments = words[1:] if words[0] == "gsim3d" else words[3:]
        assert_parses(arguments)
    elif words[0] == "torchrun":
        assert_parses(words[words.index("gsim3d") + 1 :])
    else:
        assert words[0] in {"pip", "cmake", "ctest", "git", "cd"}, words


def test_ops_in_the_table_are_public():
    from gsim3d import ops

    table = README.split("## Ops")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    functions = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert functions == {name for name in ops.__all__ if inspect.isfunction(getattr(ops, name))} - {"cuda_compiled"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the README's scenes are, a shorter one in place of each."""
    folder = tmp_path_factory.mktemp("readme")
    options = ["--preset", "diverse", "--objects", "ball", "--trajectories", "1", "--frames", "6"]
    done = run(["-m", "gsim3d", "generate", "elastic", *options, "--out", "runs/data", "--quiet"], folder)
    assert done.returncode == 0, done.stderr
    return folder


def run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess:
    env = {"PYTHONPATH": str(ROOT), "PATH": "", "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=env, cwd=folder)


@pytest.mark.parametrize("snippet", blocks("python"), ids=["predict", "rasterize"])
def test_python_snippet_prints_what_it_says(snippet, folder):
    assert len([line for line in snippet.splitlines() if line.strip()]) <= 12
    done = run(["-W", "error::UserWarning", "-c", snippet], folder)
    assert done.returncode == 0, done.stderr
    expected = re.findall(r"# prints: (.*)", snippet)
    assert expected and done.stdout.splitlines() == expected


@pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is not installed")
def test_cpp_snippet_is_the_tested_consumer():
    consumer = ROOT / "tests" / "cpp" / "consumer"
    page = (ROOT / "docs" / "tutorials" / "kernels_in_your_project.md").read_text()
    assert blocks("cmake", page)[0].strip() in (consumer / "CMakeLists.txt").read_text()
    assert blocks("cpp", page)[0].strip() in (consumer / "app.cpp").read_text()
