"""Imports flow one way, and the core knows no framework."""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent

# Each room may import the rooms before it (and its own), never one after it.
ROOMS = [
    {"errors", "quirks", "plain", "pickles"},
    {"types", "stability", "terminal", "files", "locks", "ranges", "pretrained", "branches", "processor"},
    {"selections"},
    {"ops", "effects", "harmonics", "rotations"},
    {"layers", "guards"},
    {"encoder", "dynamics", "renderer"},
    {"presets", "edits"},
    {"plans"},
    {"simulator"},
    {"laws", "graphs", "by_scene", "agreement"},
    {"endurance"},
    {"data", "interop", "perceptual"},
    {"io"},
    {"viewer"},
    {"generate"},
    {"train"},
    {"evaluate", "check_stability"},
    {"pareto"},
    {"ablate"},
    {"simulate", "show_plan", "infer_effects", "check_data", "import_released", "demo", "doctor", "export"},
    {"__main__"},
]
LEVEL = {room: level for level, rooms in enumerate(ROOMS) for room in rooms}


def room_of(path: Path) -> str:
    return path.relative_to(ROOT / "gsim3d").parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "gsim3d" and len(parts) > 1 and parts[1] in LEVEL:
                rooms.add(parts[1])
    return rooms


def python_files():
    files = sorted((ROOT / "gsim3d").rglob("*.py"))
    assert len(files) > 10
    return [path for path in files if room_of(path) != "__init__"]


def test_every_room_has_a_level():
    assert {room_of(path) for path in python_files()} <= set(LEVEL)


def test_imports_flow_one_way():
    wrong = [
        f"{path.relative_to(ROOT)} imports gsim3d.{other}"
        for path in python_files()
        for other in imported_rooms(path)
        if other != room_of(path) and LEVEL[other] >= LEVEL[room_of(path)] and not (room_of(path) == "__main__")
    ]
    assert not wrong, "\n".join(wrong)


def test_oracles_do_not_import_what_they_judge():
    oracles = sorted((ROOT / "tests" / "oracle").glob("*.py"))
    assert oracles
    for path in oracles:
        assert not re.search(r"^\s*(from|import) gsim3d|torch\.ops\.gsim3d", path.read_text(), re.MULTILINE), path


def test_core_includes_no_framework_header():
    sources = [p for p in (ROOT / "csrc").rglob("*") if p.suffix in {".h", ".inc", ".cpp", ".cu", ".cuh"}]
    assert len(sources) > 10
    for path in sources:
        framework = path.parent.name == "torch" or path.name.endswith("_torch.cpp")
        numpy = path.parent.name == "numpy"
        for header in re.findall(r'^#include [<"]([^>"]+)', path.read_text(), re.MULTILINE):
            torch_header = header.startswith(("torch/", "ATen", "c10")) or "torch_utils" in header
            assert framework or not torch_header, f"{path} includes {header}"
            assert numpy or not header.startswith("pybind11"), f"{path} includes {header}"


def test_only_platform_h_asks_which_compiler_reads():
    for path in (ROOT / "csrc").rglob("*.h"):
        if path.name != "platform.h":
            assert "__CUDACC__" not in path.read_text(), path


def test_files_stay_small():
    long = [
        (path.relative_to(ROOT), lines)
        for folder in ("csrc", "gsim3d", "tests", "tools")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".cpp", ".cu", ".cuh", ".h", ".inc", ".sh"}
        and (lines := len(path.read_text().splitlines())) > 600
    ]
    assert not long, long


def test_lines_stay_short():
    long = [
        f"{path.relative_to(ROOT)}:{number}"
        for folder in ("gsim3d", "tests", "tools")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".sh"}
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > 120
    ]
    assert not long, long


def test_no_folder_of_tests_is_on_the_path():
    """Children inherit it: there a module of tests would hide one of the standard library that has its name."""
    folder = (ROOT / "tests").resolve()
    assert not [place for place in sys.path if place and Path(place).resolve().is_relative_to(folder)]
