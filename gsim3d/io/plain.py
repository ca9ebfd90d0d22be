"""Plain values from untrusted YAML and JSON text, in bounded time and memory."""

import json
from typing import Any

import yaml

MAX_YAML = 4 * 2**20  # bytes; a second of reading each MiB
MAX_VALUES = 10**6  # of a document, an alias counted as all that it stands for
MAX_DIGITS = 100  # characters of a number

LARGEST = {int: 2**63 - 1, float: 3.4028234663852886e38}  # what int64 and float32 hold


class _Loader(yaml.SafeLoader):
    """Refuses documents that aliases or merges make huge, endless ones, and numbers of thousands of digits."""

    def get_single_node(self):
        node = super().get_single_node()
        if node is not None and _size(node, {}) > MAX_VALUES:
            raise ValueError(f"it stands for more than {MAX_VALUES} values")
        return node

    def construct_yaml_int(self, node):
        return super().construct_yaml_int(_short(node))

    def construct_yaml_float(self, node):
        return super().construct_yaml_float(_short(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


def parse_yaml(text: bytes) -> Any:
    """Plain values of a YAML (or JSON) document.

    Raises:
        ValueError: it is none, or too large; the message is one short line.
    """
    if len(text) > MAX_YAML:
        raise ValueError(f"it has {len(text)} bytes; more than {MAX_YAML} are refused")
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError, MemoryError) as error:
        raise ValueError((" ".join(str(error).split()) or type(error).__name__)[:300]) from None


def parse_json(text: bytes) -> Any:
    """Values of a JSON document. Raises ValueError where it is none, or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def is_number(value: Any, kind: type) -> bool:
    """Whether ``value`` is a finite number that ``kind`` (int or float) holds; a whole number is a float, too."""
    allowed = (int,) if kind is int else (int, float)
    return isinstance(value, allowed) and not isinstance(value, bool) and abs(value) <= LARGEST[kind]


def _size(node: yaml.Node, known: dict[int, float]) -> float:
    """Values that a node stands for; infinite where it holds itself."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in known:
        known[id(node)] = float("inf")
        parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(node)]


def _short(node: yaml.ScalarNode) -> yaml.ScalarNode:
    if len(node.value) > MAX_DIGITS:
        raise ValueError(f"a number of {len(node.value)} characters")
    return node
