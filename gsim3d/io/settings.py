"""Nested dataclasses from plain data and back: typed, naming every key that is unknown, missing or of a wrong type."""

import dataclasses
import types
import typing
from contextlib import suppress
from typing import Any, TypeVar

from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import shown
from gsim3d.io.plain import is_number

T = TypeVar("T")


def to_dict(value: Any) -> Any:
    """Dataclasses, tuples and plain values as what YAML and JSON can hold."""
    if dataclasses.is_dataclass(value):
        return {f.name: to_dict(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
    if isinstance(value, (tuple, list)):
        return [to_dict(item) for item in value]
    if isinstance(value, dict):
        return {key: to_dict(item) for key, item in value.items()}
    return value


def from_dict(cls: type[T], content: dict, where: str = "", base: T | None = None) -> T:
    """The dataclass ``cls`` from nested plain data, checked against the types of its fields.

    Args:
        cls: dataclass. Where it has an attribute ``alone``, a text by itself is the field of this name.
        content: plain values by the names of the fields.
        where: start of the messages: keys around these, or what the values belong to, with ": " at its end.
        base: has the values that ``content`` leaves out; None: the defaults.

    Raises:
        InputError: an unknown key, a missing one or a value of another type; the message names the key.
    """
    what = where.removesuffix(": ") or cls.__name__
    if not isinstance(content, dict):
        raise InputError(f"{what}: must be a mapping of settings; got {shown(content)}")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    unknown = [str(key) for key in content if key not in fields]
    if unknown:
        hint = _old_name(cls, unknown[0]) or did_you_mean(unknown[0], fields)
        raise InputError(f"{_join(where, unknown[0])[:200]}: unknown setting; known here: {', '.join(fields)}{hint}")
    values = {}
    for name, field in fields.items():
        if name in content:
            values[name] = _convert(hints[name], content[name], _join(where, name), getattr(base, name, None))
        elif base is not None:
            values[name] = getattr(base, name)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise InputError(f"{_join(where, name)}: this setting is missing")
    try:
        return cls(**values)
    except (InputError, ValueError) as error:
        if isinstance(error, InputError) and (not where or str(error).startswith(where.split(":")[0] + ":")):
            raise
        last = what.rpartition(" ")[2]  # which the error may name itself
        own = what.removesuffix(last) if str(error).startswith((f"{last}.", f"{last}: ")) else f"{what}: "
        raise InputError(f"{own}{error}") from None


def upgraded(cls: type, content: Any) -> Any:
    """Saved ``content`` of the dataclass ``cls`` as today's version names it.

    A class may have ``RENAMED``, old names of its settings to new ones, and ``REMOVED``, settings that are gone to the
    value with which they did nothing (``...``: with any value). What did something stays, for :func:`from_dict` to
    refuse.
    """
    if not isinstance(content, dict):
        return content
    hints, result = typing.get_type_hints(cls), {}
    renamed, removed = getattr(cls, "RENAMED", {}), getattr(cls, "REMOVED", {})
    for name, value in content.items():
        if name in removed and removed[name] in (value, ...):
            continue
        name = renamed.get(name, name)
        hint = hints.get(name)
        if dataclasses.is_dataclass(hint):
            value = upgraded(hint, value)
        elif typing.get_origin(hint) is tuple and dataclasses.is_dataclass(typing.get_args(hint)[0]):
            value = [upgraded(typing.get_args(hint)[0], item) for item in value]
        result[name] = value
    return result


def _old_name(cls: type, name: str) -> str:
    """A hint for a setting of earlier versions."""
    if name in (renamed := getattr(cls, "RENAMED", {})):
        return f"; it is now called {renamed[name]!r}"
    return "; this version no longer has it" if name in getattr(cls, "REMOVED", {}) else ""


def _convert(hint: Any, value: Any, where: str, base: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        problems = []
        for option in arguments:
            if option is type(None):
                continue
            try:
                return _convert(option, value, where, base)
            except InputError as error:
                if hasattr(option, "alone"):  # which also stands for a text
                    raise
                problems.append(error)
        raise problems[0]
    if dataclasses.is_dataclass(hint):
        if isinstance(value, str) and hasattr(hint, "alone"):
            value = {hint.alone: value}
        return from_dict(_variant(hint, value, where), value, where, base)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise InputError(f"{where}: must be a list; got {shown(value)}")
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            arguments = (arguments[0],) * len(value)
        if arguments and len(arguments) != len(value):
            raise InputError(f"{where}: must be a list of {len(arguments)}; got {shown(value)}")
        kinds = arguments or (Any,) * len(value)
        return tuple(_convert(kind, item, f"{where}[{i}]", None) for i, (kind, item) in enumerate(zip(kinds, value)))
    if origin is typing.Literal:
        if value not in arguments:
            known, hint = ", ".join(map(repr, arguments)), did_you_mean(value, map(str, arguments))
            raise InputError(f"{where}: must be one of {known}; got {shown(value)}{hint}")
        return value
    if hint is float and isinstance(value, str):  # YAML 1.1 reads 2e-4 as text
        with suppress(ValueError):
            value = float(value)
    plain = {bool: "true or false", int: "a whole number", float: "a number", str: "text", dict: "a mapping"}
    if hint in plain or origin is dict:
        kind = hint if hint in plain else dict
        if not (is_number(value, kind) if kind in (int, float) else isinstance(value, kind)):
            raise InputError(f"{where}: must be {plain[kind]}; got {shown(value)}")
        return float(value) if kind is float else value
    return value


def _variant(cls: type, value: Any, where: str) -> type:
    """``cls``, or of a class with variants the one whose ``type`` is given."""
    if (variants := getattr(cls, "VARIANTS", None)) is None or not isinstance(value, dict):
        return cls
    kind = value.get("type")
    if kind not in variants:
        hint = did_you_mean(kind, variants)
        raise InputError(f"{_join(where, 'type')}: must be one of {', '.join(variants)}; got {shown(kind)}{hint}")
    return variants[kind]


def _join(where: str, name: str) -> str:
    return f"{where}{name}" if not where or where.endswith(": ") else f"{where}.{name}"
