"""What ``import gsim3d`` offers: complete, typed and documented."""

import dataclasses
import inspect
import re
import subprocess
import sys
import typing

import pytest

import gsim3d
from gsim3d import ops

PUBLIC = {f"gsim3d.{name}": getattr(gsim3d, name) for name in gsim3d.__all__ if name != "__version__"}
PUBLIC |= {f"gsim3d.ops.{name}": getattr(ops, name) for name in ops.__all__}
SECTIONS = r"^(Args|Returns|Raises|Attributes|Gradients|Determinism|Source|Shapes|GPU|Example)\b"


def functions():
    """Name -> each public function and each public method of a public class."""
    for name, value in PUBLIC.items():
        if inspect.isclass(value) and value.__module__.startswith("gsim3d"):
            own = {key: f for key, f in vars(value).items() if not key.startswith("_")}
            for key, f in own.items():
                f = f.__func__ if isinstance(f, (classmethod, staticmethod)) else f
                f = f.fget if isinstance(f, property) else f
                if inspect.isfunction(f):
                    yield f"{name}.{key}", f
        elif inspect.isfunction(value):
            yield name, value


FUNCTIONS = dict(functions())


def test_every_op_is_there():
    assert set(ops.__all__) - {"PartialRecord", "ValidatedState", "join_records"} <= set(gsim3d.__all__)
    assert dir(gsim3d) == sorted(gsim3d.__all__)


def test_importing_loads_neither_torch_nor_ops():
    code = "import gsim3d, sys; assert not {'torch', 'gsim3d.ops'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_annotations_are_complete(name):
    signature = inspect.signature(FUNCTIONS[name])
    missing = [
        p.name for p in signature.parameters.values() if p.annotation is p.empty and p.name not in ("self", "cls")
    ]
    assert not missing and signature.return_annotation is not signature.empty, missing
    typing.get_type_hints(FUNCTIONS[name])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_is_documented(name):
    """A docstring of one line is enough where nothing is to be given."""
    function = FUNCTIONS[name]
    text = inspect.getdoc(function) or ""
    assert text, f"{name} has no docstring"
    names = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
    if not names or ".__" in name:
        return
    if "Args:" not in text:
        assert len(names) <= 2 and all(f"``{n}``" in text for n in names), f"{name}: {names} are not documented"
        return
    documented = re.findall(r"^    (\w+(?:, \w+)*):", text[text.index("Args:") :], re.MULTILINE)
    documented = {part for line in documented for part in line.split(", ")}
    assert not set(names) - documented, set(names) - documented


@pytest.mark.parametrize("name", [n for n, v in PUBLIC.items() if dataclasses.is_dataclass(v) or hasattr(v, "_fields")])
def test_every_attribute_is_documented(name):
    kind = PUBLIC[name]
    fields = kind._fields if hasattr(kind, "_fields") else [f.name for f in dataclasses.fields(kind)]
    text = inspect.getdoc(kind)
    assert "Attributes:" in text, f"{name} has no section Attributes"
    documented = set(re.findall(r"^    (\w+):", text[text.index("Attributes:") :], re.MULTILINE))
    assert not set(fields) - documented, set(fields) - documented
