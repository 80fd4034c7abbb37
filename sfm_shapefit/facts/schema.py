"""The JSON Schema of what the commands print, made of `json_types`.

python -m sfm_shapefit.facts.schema           # writes sfm_shapefit/schemas/output.schema.json anew
"""

import json
import types
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints, is_typeddict

from sfm_shapefit.facts.json_types import (
    EvaluateSummary,
    GraphSummary,
    InspectSummary,
    JoinedSummary,
    LocateSummary,
    MapSummary,
    PositionsSummary,
)

PATH = Path(__file__).parents[1] / "schemas" / "output.schema.json"

_COMMANDS = {
    "locate": LocateSummary,
    "solve_graph": GraphSummary,
    "inspect": InspectSummary,
    "evaluate": EvaluateSummary,
    "evaluate_table": PositionsSummary,
    "map": MapSummary,
    "joined": JoinedSummary,
}
_SIMPLE = {int: "integer", float: "number", str: "string", bool: "boolean", type(None): "null"}


def output_schema() -> dict[str, Any]:
    """Return one schema for all commands; `$defs` has that of each."""
    definitions: dict[str, Any] = {}
    names = {kind: name for name, kind in _COMMANDS.items()}
    for kind in _COMMANDS.values():
        _schema_of(kind, definitions, names)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Output of sfm-shapefit",
        "description": "Each command prints one object with --json. $defs has the schema of each: locate, "
        "solve_graph (the command place), inspect, evaluate (against a table: evaluate_table), map. "
        "joined is the locate.json of models that map has joined.",
        "anyOf": [{"$ref": f"#/$defs/{name}"} for name in _COMMANDS],
        "$defs": definitions,
    }


def _schema_of(kind: Any, definitions: dict[str, Any], names: dict[Any, str]) -> dict[str, Any]:
    """Return the schema of a type; that of one with fields is added to the definitions, and referred to."""
    if is_typeddict(kind) or is_dataclass(kind):
        name = names.get(kind, kind.__name__)
        if name not in definitions:
            # An empty value holds the place, so that definitions stand in the order of their use.
            definitions[name] = {}
            hints = get_type_hints(kind, include_extras=True)
            if is_dataclass(kind):
                hints = {key: _or_null(hint) for key, hint in hints.items()}
            definitions[name] |= {
                "type": "object",
                "description": (kind.__doc__ or "").split("\n")[0],
                "properties": {key: _schema_of(hint, definitions, names) for key, hint in hints.items()},
                "required": list(hints),
                "additionalProperties": False,
            }
        return {"$ref": f"#/$defs/{name}"}
    if get_origin(kind) is Annotated:
        described, sentence = get_args(kind)
        return _schema_of(described, definitions, names) | {"description": sentence}
    inner = [
        _schema_of(one, definitions, names)
        for one in get_args(kind)
        if get_origin(kind) is not Literal and one is not ...
    ]
    return _plain_schema_of(kind, inner)


def _or_null(hint: Any) -> Any:
    """Return the type of a field, where a number may be not finite, and stands as null then."""
    if get_origin(hint) is Annotated:
        return Annotated[_or_null(hint.__origin__), *hint.__metadata__]
    return float | None if hint is float else hint


def _plain_schema_of(kind: Any, inner: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the schema of a type, given those of its arguments."""
    origin = get_origin(kind)
    if origin is Literal:
        return {"enum": list(get_args(kind))}
    if origin is types.UnionType:
        return {"anyOf": inner}
    if origin in (list, tuple):
        return {"type": "array", "items": inner[0]}
    if origin is dict:
        return {"type": "object", "additionalProperties": inner[1]}
    return {} if kind is Any else {"type": _SIMPLE[kind]}


def schema_text() -> str:
    """Return the text of the schema's file."""
    return json.dumps(output_schema(), indent=2) + "\n"


if __name__ == "__main__":
    PATH.write_text(schema_text(), encoding="utf-8")
