"""What the commands print with --json keeps to the schema that is shipped."""

import json
from importlib import resources

import jsonschema
import pytest

from sfm_shapefit.facts.schema import PATH, schema_text
from tests.program import run
from tests.scenes import BUNDLED, COURTYARD, RING

RING_MODEL = RING / "sparse" / "0"
SCHEMA = json.loads((resources.files("sfm_shapefit") / "schemas" / "output.schema.json").read_text("utf-8"))


def printed(*arguments):
    return json.loads(run(*arguments, code=0).stdout)


def problems(facts, name):
    """Return where facts break the schema of a command; no key may be undocumented."""
    validator = jsonschema.Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": SCHEMA["$defs"]})
    return [f"{'/'.join(map(str, error.path))}: {error.message}" for error in validator.iter_errors(facts)]


def commands(out):
    return {
        "locate": ("locate", RING_MODEL, out, "--rotations", "free", "--adjust", "full", "--no-report"),
        "solve_graph": ("place", BUNDLED / "graph40.txt", out, "--no-report"),
        "inspect": ("inspect", RING_MODEL),
        "evaluate": ("evaluate", RING_MODEL, RING_MODEL),
        "map": ("map", COURTYARD / "database.db", out),
    }


def test_the_schema_is_one_with_a_sentence_for_every_key_and_the_shipped_one_is_that_which_is_generated():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert schema_text() == PATH.read_text("utf-8"), "run python -m sfm_shapefit.facts.schema"
    keys = {
        (name, key): kind for name, one in SCHEMA["$defs"].items() for key, kind in one["properties"].items()
    }
    assert [key for key, kind in keys.items() if not kind.get("description")] == []


@pytest.mark.parametrize("name", commands(""))
def test_what_a_command_prints_keeps_to_the_schema(name, tmp_path):
    facts = printed(*commands(tmp_path / "out")[name], "--json")
    assert problems(facts, name) == []
    jsonschema.validate(facts, SCHEMA)


def test_a_key_that_is_missing_renamed_or_unknown_breaks_the_schema():
    facts = printed("evaluate", RING_MODEL, RING_MODEL, "--json")
    assert problems({key: value for key, value in facts.items() if key != "extent"}, "evaluate")
    assert problems(facts | {"more": 1}, "evaluate")
    assert problems(facts | {"num_common": "eight"}, "evaluate")
