"""Imports flow one way, and the core knows no framework."""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent

# Three rings: the workshop imports the library and the commands import both, never the other way round. Inside a ring
# a line may import the lines above it. A name is a module, or a package with all modules that have no line of its own.
RINGS = {
    "library": """
        errors effects numerics
        numerics.policy numerics.report
        io.terminal io.plain io.pickles io.locks
        cameras
        state
        ops.streams
        ops
        math
        io.files
        io.settings pretrained
        numerics.validate effects.selection
        effects.spec
        nn
        priors
        dynamics
        compat.checkpoints io
        effects.edits effects.actors
        presets
        effects.plan
        cuda_graphs
        numerics.trust numerics.rollout_graphs
        numerics.speed
        pretrained.loading
        simulator
    """,
    "workshop": """
        compat
        data evaluate.perceptual planning
        evaluate.metrics
        baselines
        train
        viewer
        synth
        evaluate envs
        testing
        profile capture
        reproduce
    """,
    "commands": """
        cli.arguments
        cli
        __main__
    """,
}
LINES = [set(line.split()) for ring in RINGS.values() for line in ring.strip().splitlines()]
LEVEL = {name: level for level, names in enumerate(LINES) for name in names}
MOST_AT_THE_TOP = 8  # modules directly below gsim3d/


def home_of(module: str) -> str:
    """The longest name in LEVEL that ``module`` (without "gsim3d.") is, or lies in."""
    parts = module.split(".")
    names = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((name for name in names if name in LEVEL), parts[0])


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT / "gsim3d").with_suffix("").parts).removesuffix(".__init__")


def imported_homes(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        found |= {home_of(name.removeprefix("gsim3d.")) for name in names if name.startswith("gsim3d.")}
    return found & set(LEVEL)


def python_files():
    files = sorted((ROOT / "gsim3d").rglob("*.py"))
    assert len(files) > 10
    return [path for path in files if module_of(path) != "__init__"]


def test_every_module_has_a_level():
    assert {home_of(module_of(path)) for path in python_files()} <= set(LEVEL)


def test_imports_flow_one_way():
    wrong = [
        f"{path.relative_to(ROOT)} imports gsim3d.{other}"
        for path in python_files()
        for home in [home_of(module_of(path))]
        for other in imported_homes(path)
        if other != home and LEVEL[other] >= LEVEL[home]
    ]
    assert not wrong, "\n".join(wrong)


def imported_files(path: Path, files: dict[str, Path]) -> set[str]:
    """Modules that ``path`` imports when it runs: everywhere but under TYPE_CHECKING."""
    found, left = set(), [ast.parse(path.read_text())]
    while left:
        node = left.pop()
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}".removeprefix("gsim3d.") for alias in node.names]
            found |= {name if name in files else name.rpartition(".")[0] for name in names}
        elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            left += ast.iter_child_nodes(node)
    return found & set(files)


def test_no_file_imports_itself():
    files = {module_of(path): path for path in python_files()}
    imports = {name: imported_files(path, files) - {name} for name, path in files.items()}
    while ends := {name for name, others in imports.items() if not others}:  # what is left at last is in circles
        imports = {name: others - ends for name, others in imports.items() if name not in ends}
    assert not imports


def test_the_top_level_is_small():
    modules = list((ROOT / "gsim3d").glob("*.py"))
    assert len(modules) <= MOST_AT_THE_TOP, sorted(path.name for path in modules)


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
