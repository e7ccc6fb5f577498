"""TOML in and out, and what to say about bad input.  Knows no key of a scenario by name."""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError


class InvalidInput(ValueError):
    """What a user gave cannot be used: one line per problem in ``problems`` (exit code 2)."""

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems = [problems] if isinstance(problems, str) else list(problems)
        super().__init__("\n".join(self.problems))


class Unsupported(InvalidInput):
    """Each value is good in itself, together they mean nothing (exit code 2)."""


# -- reading ------------------------------------------------------------------------------------


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """A TOML text as a dict; a duplicate key or a slip of syntax is named with its line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message, line = str(error), ""
        at = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", message)
        if at:
            message = message[: at.start()]
            line = f" line {at.group(1) or text.count(chr(10)) + 1}"
        if message.startswith(("Cannot overwrite", "Cannot declare")):
            message = f"given twice, each key and table is expected once ({message})"
        raise InvalidInput(f"{source}{line}: not valid TOML: {message}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as a dict.  `InvalidInput` names a missing, unreadable or binary file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InvalidInput(f"{path}: no such file, expected a scenario (TOML)") from None
    except UnicodeDecodeError:
        raise InvalidInput(f"{path}: not a text file, expected a scenario (TOML, UTF-8)") from None
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror})") from None
    return parse_toml(text, str(path))


def parse_override(text: str, option: str = "--set") -> tuple[str, Any]:
    """``imu.lag_s=0.0025`` -> ("imu.lag_s", 0.0025); the value is TOML, a bare word a string."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not (equals and key and value):
        raise InvalidInput(f"{option} {text!r}: expected key=value, e.g. imu.lag_s=0.0025")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value.strip("'\"")


def merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``change`` laid over it: tables are merged key by key, all else replaced."""
    merged = dict(base)
    for key, value in change.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = merge(below, value)
        merged[key] = value
    return merged


def nest(dotted: Mapping[str, Any] | Iterable[str]) -> dict[str, Any]:
    """{"imu.lag_s": 1} or ["imu.lag_s=1"] as nested tables; a key given twice is refused."""
    pairs = (
        list(dotted.items())
        if isinstance(dotted, Mapping)
        else [parse_override(text) for text in dotted]
    )
    tree: dict[str, Any] = {}
    problems = []
    for key, value in pairs:
        *tables, leaf = key.split(".")
        node: Any = tree
        for table in tables:
            node = node.setdefault(table, {}) if isinstance(node, dict) else None
        if not isinstance(node, dict) or leaf in node:
            problems.append(f"{key}: given twice, expected once")
        else:
            node[leaf] = value
    if problems:
        raise InvalidInput(problems)
    return tree


def without(tree: Mapping[str, Any], location: list[str]) -> dict[str, Any]:
    """``tree`` without the value at ``location`` (or without the list that holds it)."""
    rest = {k: v for k, v in tree.items() if k != location[0]}
    inner = tree.get(location[0])
    if len(location) > 1 and isinstance(inner, Mapping):
        rest[location[0]] = without(inner, location[1:])
    return rest


def resolved(
    name: str,
    presets: Sequence[str],
    preset_text: Callable[[str], str],
    relative_to: Callable[[Path, dict[str, Any]], dict[str, Any]],
    below: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The merged tree of a preset or TOML file and of all that it ``extends``.

    ``relative_to(folder, tree)`` turns file names inside a tree into paths.  A file without
    ``name`` is named after itself, and title and reason of what it extends are not its own.
    `InvalidInput` for a cycle or a name that means nothing.
    """
    path = Path(name)
    if name in presets:
        key, tree = name, parse_toml(preset_text(name), f"preset {name}")
    else:
        if path.suffix != ".toml" and not path.is_file():
            near = difflib.get_close_matches(name, presets, 1, 0.5)
            hint = f"did you mean {near[0]}?" if near else f"presets are {', '.join(presets)}"
            raise InvalidInput(f"{name}: neither a preset nor a TOML file, {hint}")
        key, tree = str(path.resolve()), relative_to(path.parent, read_toml(path))
    if key in below:
        chain = " -> ".join(Path(k).name for k in (*below, key))
        raise InvalidInput(f"{name}: extends itself ({chain}), expected a chain that ends")
    tree = {"name": path.name.removesuffix(".toml")} | tree
    base = tree.pop("extends", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise InvalidInput(f"{name}: extends: {show(base)} given, expected a preset or a TOML file")
    if base not in presets:
        base = str(path.parent / base)
    tree = {"title": f"{Path(base).name.removesuffix('.toml')}, changed", "why": ""} | tree
    return merge(resolved(base, presets, preset_text, relative_to, (*below, key)), tree)


# -- writing ------------------------------------------------------------------------------------


def _toml_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value).lower() if isinstance(value, bool) else repr(value)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)


def write_toml(
    tree: Mapping[str, Any], prefix: str = "", notes: Mapping[str, str] | None = None
) -> str:
    """A nested dict as TOML text; keys that are None are left out.

    ``notes`` (dotted key -> meaning) become comments, and keys that are None with them.
    """
    lines, tables = [], []
    for name, value in tree.items():
        path = f"{prefix}{_key(name)}"
        note = f"  # {notes[path]}" if notes and notes.get(path) else ""
        if isinstance(value, Mapping):
            tables.append(f"\n[{path}]{note}\n" + write_toml(value, f"{path}.", notes))
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            for i, item in enumerate(value):  # notes once are enough
                body = write_toml(item, f"{path}.", None if i else notes)
                tables.append(f"\n[[{path}]]{'' if i else note}\n{body}")
        elif value is not None:
            lines.append(f"{_key(name)} = {_toml_value(value)}{note}\n")
        elif notes is not None:
            lines.append(f"# {_key(name)} = ...{note}\n")
    return "".join(lines + tables)


# -- what keys there are --------------------------------------------------------------------------

_UNITS = {
    "_mps3_sqrt_hz": "m/s3/sqrt(Hz)", "_m_sqrt_s": "m/sqrt(s)",
    "_mps_sqrt_s": "m/s/sqrt(s)", "_rad_sqrt_s": "rad/sqrt(s)", "_lla_deg_m": "deg, deg, m",
    "_ppb_per_g": "ppb/g", "_deg_h_g": "deg/h/g", "_deg_h": "deg/h", "_deg_s": "deg/s",
    "_mps2": "m/s2", "_mps": "m/s", "_s_db": "s, dB", "_dbhz": "dB-Hz", "_db": "dB",
    "_mrad": "mrad", "_chips": "chips", "_ppm": "ppm", "_deg": "deg", "_hz": "Hz", "_mg": "mg",
    "_ug": "ug", "_g": "g", "_m": "m", "_s": "s",
}  # fmt: skip
"""Endings of keys, longer ones first"""
_KINDS = {bool: "true or false", int: "whole number", float: "number", str: "text"}


class Key(NamedTuple):
    """A key in words; a table has neither unit nor default."""

    name: str
    unit: str
    expected: str
    default: str
    meaning: str


def unit(name: str) -> str:
    """The unit that a key's ending says; empty where there is none."""
    return next((u for ending, u in _UNITS.items() if name.endswith(ending)), "")


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[Key]:
    """Every key of a model and of its tables, in the order of their definition."""
    for name, field in model.model_fields.items():
        inner = _models(field.annotation)
        text = field.description or (inner[0].__doc__ if inner else "") or ""
        meaning = " ".join(text.replace("``", "").split()).removesuffix(".")
        if inner:
            yield Key(prefix + name, "", "table", "", meaning)
            yield from keys(inner[0], f"{prefix}{name}.")
            continue
        default = "required" if field.is_required() else show(field.default)
        if field.default is None:
            default = "left out"
        expected = _expected(field.annotation, field.metadata)
        yield Key(prefix + name, unit(name), expected, default, meaning)


def _expected(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """What a value must be: a kind, with bounds where there are some."""
    arguments = get_args(annotation)
    if type(None) in arguments:
        return _expected(next(a for a in arguments if a is not type(None)), metadata)
    if hasattr(annotation, "__metadata__"):
        inner, *more = arguments
        return _expected(inner, [m for x in more for m in getattr(x, "metadata", None) or [x]])
    if get_origin(annotation) is Literal:
        *most, last = map(str, arguments)
        return ", ".join(most) + " or " + last
    if get_origin(annotation) is dict:
        return f"table of {_expected(arguments[1])}"
    if get_origin(annotation) is tuple:
        each = [_expected(a) for a in arguments if a is not Ellipsis]
        if Ellipsis in arguments:
            return f"list of {each[0]}"
        return f"[{each[0]}] x {len(each)}" if len(set(each)) == 1 else f"[{'; '.join(each)}]"
    limits = {s: v for m in metadata for s in _SHORT if (v := getattr(m, s, None)) is not None}
    kind = _KINDS.get(annotation, "value")
    if set(limits) == {"ge", "le"}:
        return "{} {ge:g} to {le:g}".format(kind, **limits)
    bounds = [_BOUNDS[_SHORT[short]].format(**limits) for short in limits]
    return " ".join([kind, " and ".join(bounds)]).strip()


# -- what to say ----------------------------------------------------------------------------------

_WITH_UNIT = re.compile(r"\s*[-+]?(\d[\d_.]*|\.\d+)([eE][-+]?\d+)?\s*[^\d\s.,]\S*\s*")
_PLAIN_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "a text in quotes",
    "string_too_short": "a text that is not empty",
    "model_type": "a table of keys",
    "dict_type": "a table of keys",
    "tuple_type": "a list in square brackets",
    "is_instance_of": "a table of keys",
}
_SHORT = {
    "gt": "greater_than", "ge": "greater_than_equal", "lt": "less_than", "le": "less_than_equal"
}  # fmt: skip
_BOUNDS = {
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "less than {lt:g}",
    "less_than_equal": "{le:g} or less",
}


def dotted(location: Iterable[str | int]) -> str:
    """("profile", 0, "t0_s") -> ``profile[0].t0_s``."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models that an annotation mentions: a table, or the rows of a list of tables."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for part in get_args(annotation) for m in _models(part)]


def _known_keys(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """Keys that the table around ``location`` takes."""
    for part in location[:-1]:
        if isinstance(part, int):
            continue
        field = model.model_fields.get(part)
        inner = _models(field.annotation) if field else []
        if not inner:
            return []
        model = inner[0]
    return list(model.model_fields)


def _tuple_length(model: type[BaseModel], location: Sequence[str | int]) -> int | None:
    """How many entries the fixed-length list at ``location`` has; None where it is no such list."""
    annotation: Any = model
    for part in location:
        if isinstance(part, str):
            models = _models(annotation)
            field = models[0].model_fields.get(part) if models else None
            if field is None:
                return None
            annotation = field.annotation
        else:
            annotation = get_args(annotation)[0] if get_args(annotation) else None
        if get_origin(annotation) is Union or type(None) in get_args(annotation):
            annotation = next(a for a in get_args(annotation) if a is not type(None))
    if get_origin(annotation) is not tuple or get_args(annotation)[-1] is Ellipsis:
        return None
    return len(get_args(annotation))


def _problem(model: type[BaseModel], error: Mapping[str, Any]) -> str:
    kind, location, given = error["type"], list(error["loc"]), error["input"]
    context = error.get("ctx") or {}
    if kind in ("missing", "too_long", "too_short"):
        row = location[:-1] if kind == "missing" and isinstance(location[-1], int) else location
        length = _tuple_length(model, row)
        if length:
            given = given if isinstance(given, list | tuple) else "another length"
            return f"{dotted(row)}: {show(given)} given, expected {length} values"
        if kind == "missing":
            return f"{dotted(location)}: missing, expected a value"
    if kind == "extra_forbidden":
        keys = _known_keys(model, location)
        given = str(location[-1])
        # first the longest key that is the given one but for its unit or a prefix of the given one
        near = [k for k in keys if f"_{given}".endswith((f"_{k}", f"_{k.rpartition('_')[0] or k}"))]
        near.sort(key=len, reverse=True)
        near = near or difflib.get_close_matches(given, keys, 1) or [k for k in keys if given in k]
        hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(keys)}"
        return f"{dotted(location)}: unknown key, {hint}"
    if (
        kind in ("float_type", "int_type")
        and isinstance(given, str)
        and _WITH_UNIT.fullmatch(given)
    ):
        expected = "a number without unit (the key's name says the unit)"
    elif kind == "literal_error":
        expected = "one of " + context["expected"].replace("'", '"')
    elif kind in _BOUNDS:
        expected = _BOUNDS[kind].format(**context)
    elif kind == "tuple_type" and (length := _tuple_length(model, location)):
        expected = f"a list of {length} numbers"
    else:
        expected = _PLAIN_TYPES.get(kind, error["msg"])
    return f"{dotted(location)}: {show(given)} given, expected {expected}"


def show(value: Any) -> str:
    """A value as it would stand in a TOML file, cut to one short line."""
    if isinstance(value, tuple | list | str | bool | int | float):
        text = _toml_value(value)
    else:
        text = "a table" if isinstance(value, Mapping) else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


def problems(model: type[BaseModel], error: ValidationError) -> list[str]:
    """One line per problem: key, value given, what is expected."""
    return list(dict.fromkeys(_problem(model, item) for item in error.errors(include_url=False)))
