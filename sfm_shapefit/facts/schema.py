"""The JSON Schema of what the commands print, made of the records.

python -m sfm_shapefit.facts.schema           # writes sfm_shapefit/schemas/output.schema.json anew
"""

import json
from pathlib import Path
from typing import Any

from sfm_shapefit.base.record import schema_of
from sfm_shapefit.facts.checked_pieces import CheckedPieces
from sfm_shapefit.facts.inspected import Inspection
from sfm_shapefit.facts.lengths import LengthsFacts
from sfm_shapefit.facts.model import CheckedFacts, JoinedFacts, MapFacts, ModelFacts
from sfm_shapefit.facts.placed import GraphFacts
from sfm_shapefit.scene.evaluation import EvaluationFacts, PositionFacts

PATH = Path(__file__).parents[1] / "schemas" / "output.schema.json"

_COMMANDS = {
    "locate": ModelFacts,
    "solve_graph": GraphFacts,
    "inspect": Inspection,
    "evaluate": EvaluationFacts,
    "evaluate_table": PositionFacts,
    "evaluate_lengths": LengthsFacts,
    "check": CheckedFacts,
    "check_pieces": CheckedPieces,
    "map": MapFacts,
    "joined": JoinedFacts,
}


def output_schema() -> dict[str, Any]:
    """Return one schema for all commands; `$defs` has that of each."""
    definitions: dict[str, Any] = {}
    names = {kind: name for name, kind in _COMMANDS.items()}
    for kind in names:
        schema_of(kind, definitions, names)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Output of sfm-shapefit",
        "description": "Each command prints one object with --json. $defs has the schema of each: locate, "
        "solve_graph (the command place), inspect, evaluate (against a table: evaluate_table; of a model "
        "alone: evaluate_lengths), check (of several models: check_pieces), map. joined is the locate.json "
        "of models that map has joined.",
        "anyOf": [{"$ref": f"#/$defs/{name}"} for name in _COMMANDS],
        "$defs": definitions,
    }


def schema_text() -> str:
    """Return the text of the schema's file."""
    return json.dumps(output_schema(), indent=2) + "\n"


if __name__ == "__main__":
    PATH.write_text(schema_text(), encoding="utf-8")
