"""Records: frozen values whose fields carry their sentences. JSON and its schema are made of them.

class Lud(Record):
    "The LUD start."

    iterations: Annotated[int, "Steps of the solver."]
    costs: FloatArray    # without a sentence: not in the JSON, for those who compute with the record

lud.summary()    # plain values, as they stand in JSON
"""

import enum
import json
import math
import types
from collections.abc import Mapping
from dataclasses import Field, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

_SIMPLE = {int: "integer", float: "number", str: "string", bool: "boolean", type(None): "null"}


_ABSENT = object()  # value of an attribute that a source does not have


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Record:
    """A frozen dataclass by inheritance, with keyword arguments. Numbers that are not finite become None."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls, *, repr: bool = True) -> None:  # noqa: A002  as dataclasses call it
        dataclass(frozen=True, kw_only=True, repr=repr)(cls)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float) and not math.isfinite(value):
                object.__setattr__(self, item.name, None)

    @classmethod
    def taken_from(cls, source: object, **others: Any) -> Self:
        """Return the record of other values, and a source's attributes that bear the names of its fields."""
        names = (item.name for item in fields(cls) if item.name not in others)
        taken = ((name, getattr(source, name, _ABSENT)) for name in names)  # once; it may be computed
        return cls(**others, **{name: value for name, value in taken if value is not _ABSENT})

    @classmethod
    def of(cls, source: object) -> Self | None:
        """Return the record of a source's attributes; None of None."""
        return None if source is None else cls.taken_from(source)

    def summary(self) -> dict[str, Any]:
        """Return plain values, as they stand in JSON."""
        return dict(plain(self))


@cache
def told_fields(kind: Any) -> tuple[str, ...]:
    """Return the names of a dataclass's fields that stand in JSON: of a record those with a sentence."""
    every = not issubclass(kind, Record)
    return tuple(item.name for item in fields(kind) if every or get_origin(item.type) is Annotated)


@cache
def hints_of(kind: Any) -> dict[str, Any]:
    """Return the types of the fields that stand in JSON, with their sentences."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in told_fields(kind)}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: dataclasses as dictionaries, None for numbers that are not finite."""
    if isinstance(value, enum.Enum):
        return value.value
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(getattr(value, name)) for name in told_fields(type(value))}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def dumps(summary: dict[str, Any], *, only_ascii: bool = False) -> str:
    """Return plain values as JSON text that UTF-8 can encode, or ASCII, with escapes for all else.

    NaN and infinities, which JSON has not, become null. Bytes of a path that are no UTF-8 become the escape
    \\udcXX, from which `os.fsencode` of the parsed text gives them back.
    """
    text = json.dumps(plain(summary), indent=2, ensure_ascii=only_ascii, allow_nan=False)
    return text.encode("utf-8", errors="backslashreplace").decode("utf-8")  # Python's escape is JSON's


def write_json(summary: dict[str, Any], path: Path) -> None:
    """Write plain values as JSON, with null for numbers that are not finite."""
    path.write_text(dumps(summary) + "\n", encoding="utf-8")


def schema_of(kind: Any, definitions: dict[str, Any], names: Mapping[Any, str]) -> dict[str, Any]:
    """Return the JSON Schema of a type; that of one with fields is added to the definitions, and referred to.

    Args:
        kind: a type with or without a sentence.
        definitions: the schemas of types with fields, by name.
        names: of types that are not called as their class is.
    """
    if is_dataclass(kind):
        return _schema_of_fields(kind, definitions, names)
    if get_origin(kind) is Annotated:
        described, sentence = get_args(kind)
        return schema_of(described, definitions, names) | {"description": sentence}
    if get_origin(kind) is Literal:
        return {"enum": list(get_args(kind))}
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return {"enum": [one.value for one in kind]}
    inner = [schema_of(one, definitions, names) for one in get_args(kind) if one is not ...]
    return _plain_schema(kind, inner)


def _plain_schema(kind: Any, inner: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the schema of a type without fields, given those of its arguments."""
    origin = get_origin(kind)
    if origin is types.UnionType:
        return {"anyOf": inner}
    if origin in (list, tuple):
        return {"type": "array", "items": inner[0]}
    if origin is dict:
        return {"type": "object", "additionalProperties": inner[1]}
    return {} if kind is Any else {"type": _SIMPLE[kind]}


def _schema_of_fields(kind: Any, definitions: dict[str, Any], names: Mapping[Any, str]) -> dict[str, Any]:
    name = names.get(kind, kind.__name__)
    if name not in definitions:
        # An empty value holds the place, so that definitions stand in the order of their use.
        definitions[name] = {}
        hints = hints_of(kind)
        definitions[name] |= {
            "type": "object",
            "description": (kind.__doc__ or "").split("\n")[0],
            "properties": {key: schema_of(hint, definitions, names) for key, hint in hints.items()},
            "required": list(hints),
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{name}"}
