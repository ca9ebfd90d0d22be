"""The words, docstrings and format of the repository (docs/contributing/style.md has the glossary)."""

import ast
import functools
import io
import re
import shutil
import subprocess
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BANNED = re.compile(
    r"\b(nobody|somebody|everybody|sittings?|(?-i:[Ff]ilms?)|told|daylight|relit|unlit|likewise|"
    r"(?:the|of|moving|frozen) matter)\b",
    re.IGNORECASE,
)
# Old names of settings that a converter, its tests or a stored file must still spell.
STORED = (
    "gsim3d/compat/",
    "gsim3d/pretrained/",
    "tools/release/state/",
    "tests/compat/",
    "tests/test_style.py",
)
# Areas whose owners have not landed yet.
PENDING: tuple[str, ...] = ()
SECTIONS = "Args Attributes Returns Yields Raises Shapes Gradients Determinism Source Example".split()
SECTION = re.compile(rf"^(\s*)({'|'.join(SECTIONS)}):(.*)$")
ENTRY = re.compile(r"^\s*(\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: \(.*?\))?:")


def tracked(*suffixes):
    """Tracked files with one of these suffixes, by their names in the repository."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True).stdout.split("\0")
    if not any(names):  # an unpacked archive
        names = [path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*") if path.is_file()]
    found = [name for name in names if name.endswith(suffixes) and (ROOT / name).is_file()]
    assert found
    return [name for name in found if not name.startswith((*STORED, *PENDING, "docs/notes/", "CHANGELOG"))]


def texts(name):
    """(line number, text) of the strings, comments and names of functions of a Python file, of all lines of others."""
    source = (ROOT / name).read_text(encoding="utf-8")
    if not name.endswith(".py"):
        yield from enumerate(source.splitlines(), 1)
        return
    kinds = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    before = ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in kinds:
            yield token.start[0], token.string
        elif before == "def":
            yield token.start[0], token.string.replace("_", " ")
        before = token.string


def test_words_of_the_field():
    found = [
        f"{name}:{line}: {match[0]}"
        for name in tracked(".py", ".md", ".yaml", ".yml", ".toml", ".h", ".cpp", ".cu", ".cuh", ".js", ".html", ".sh")
        for line, text in texts(name)
        for match in BANNED.finditer(text)
    ]
    assert not found, f"{len(found)} words that the glossary replaces:\n" + "\n".join(found)


@functools.cache
def modules():
    """(name, syntax tree) of the public modules of the package."""
    names = [name for name in tracked(".py") if name.startswith("gsim3d/")]
    return [(name, ast.parse((ROOT / name).read_text())) for name in names if not Path(name).stem.startswith("_")]


def is_dataclass(node):
    names = (ast.unparse(decorator) for decorator in node.decorator_list)
    return any(re.fullmatch(r"(dataclasses\.)?dataclass(\(.*\))?", name) for name in names)


def sections(docstring):
    """Section -> names of its entries, of a docstring in Google style; "Args: x" in one line is no section."""
    found, section, margin = {}, None, None
    for line in docstring.splitlines():
        if match := SECTION.match(line):
            section, margin = (match[2], None) if not match[3].strip() else (None, None)
            found.setdefault(match[2], [])
        elif section and line.strip():
            indent = len(line) - len(line.lstrip())
            margin = indent if margin is None else margin
            if indent == margin and (entry := ENTRY.match(line)):
                found[section] += [name.strip().lstrip("*") for name in entry[1].split(",")]
    return found


def documented_fields():
    """(file, dataclass, its fields, those that it documents: below "Attributes:", by "#:" or in a base class)."""
    known, found = {}, []
    for name, tree in modules():
        lines = (ROOT / name).read_text().splitlines()
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and is_dataclass(node):
                fields = [f for f in node.body if isinstance(f, ast.AnnAssign) and "ClassVar" not in ast.unparse(f)]
                documented = set(sections(ast.get_docstring(node) or "").get("Attributes", []))
                documented |= {f.target.id for f in fields if "#: " in lines[f.end_lineno - 1]}
                documented |= {f.target.id for f in fields if lines[f.lineno - 2].lstrip().startswith("#: ")}
                bases = [ast.unparse(base).rpartition(".")[2] for base in node.bases]
                known[node.name] = documented, bases
                found.append((name, node.name, [f.target.id for f in fields], documented, bases))

    def with_bases(documented, bases):
        return documented.union(*(with_bases(*known.get(base, (set(), ()))) for base in bases))

    return [(name, owner, fields, with_bases(documented, bases)) for name, owner, fields, documented, bases in found]


def test_fields_of_public_dataclasses_are_documented():
    missing = [
        f"{name}: {owner}.{field}"
        for name, owner, fields, documented in documented_fields()
        for field in fields
        if not owner.startswith("_") and not field.startswith("_") and field not in documented
    ]
    assert not missing, f"{len(missing)} fields without a line below 'Attributes:':\n" + "\n".join(missing)


def public_functions():
    """(where, node) of the public functions and methods of the package."""
    for name, tree in modules():
        for node in tree.body:
            inside = node.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_") else [node]
            owner = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
            for function in inside:
                if isinstance(function, ast.FunctionDef) and not function.name.startswith("_"):
                    yield f"{name}: {owner}{function.name}", function


def test_sections_of_docstrings_have_one_order():
    order = ["Args", "Returns", "Yields", "Attributes", "Gradients", "Determinism", "Raises", "Source", "Example"]
    wrong = []
    for name, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                found = [section for section in sections(ast.get_docstring(node) or "") if section in order]
                wrong += [f"{name}: {node.name}: {found}"] if found != sorted(found, key=order.index) else []
    assert not wrong, "\n".join(wrong)


def test_sections_of_docstrings_are_those_of_the_function():
    wrong = []
    for where, function in public_functions():
        docstring = ast.get_docstring(function)
        if not docstring:
            continue
        arguments = function.args
        names = {a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}
        names |= {a.arg for a in (arguments.vararg, arguments.kwarg) if a}
        wrong += [f"{where}: Args names {name}" for name in sections(docstring).get("Args", []) if name not in names]
        inline = [line.strip() for line in docstring.splitlines() if (m := SECTION.match(line)) and m[3].strip()]
        wrong += [f"{where}: a section starts on a line of its own: {line}" for line in inline]
    assert not wrong, f"{len(wrong)} docstrings:\n" + "\n".join(wrong)


@pytest.mark.skipif(shutil.which("ruff") is None, reason="needs ruff")
@pytest.mark.parametrize("command", [["check", "--quiet"], ["format", "--check", "--quiet"]])
def test_ruff(command):
    done = subprocess.run(["ruff", *command, "."], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout or f"files that `ruff {command[0]}` would change"
