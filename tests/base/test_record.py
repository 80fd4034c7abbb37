"""Records: their plain values, and the schema of these."""

import enum
import math
from typing import Annotated, Literal

from sfm_shapefit.base.record import Record, dumps, plain, schema_of


class Color(enum.Enum):
    RED = "red"


class Inner(Record):
    """What is inside."""

    length: Annotated[float | None, "How long it is."]


class Outer(Record):
    """What is outside.

    More of it.
    """

    color: Annotated[Color, "Its color."]
    parts: Annotated[tuple[Inner, ...], "Its parts."]
    names: Annotated[dict[str, Inner], "Parts by name."]
    kind: Annotated[Literal["a", "b"], "What it is."] = "a"


RECORD = Outer(
    color=Color.RED, parts=(Inner(length=1.0), Inner(length=math.nan)), names={"x": Inner(length=2.0)}
)


def test_plain_values_are_those_of_json():
    values = RECORD.summary()
    assert values == {
        "color": "red",
        "parts": [{"length": 1.0}, {"length": None}],
        "names": {"x": {"length": 2.0}},
        "kind": "a",
    }
    assert dumps({"values": (math.inf, 1.0)}) == '{\n  "values": [\n    null,\n    1.0\n  ]\n}'


def test_a_record_of_attributes_takes_those_of_its_fields_and_none_is_none():
    assert Inner.of(Inner(length=3.0)) == Inner(length=3.0)
    assert Inner.of(None) is None


def test_the_schema_has_each_record_once_with_the_sentences_of_its_fields():
    definitions = {}
    assert schema_of(Outer, definitions, {Outer: "outer"}) == {"$ref": "#/$defs/outer"}
    assert list(definitions) == ["outer", "Inner"]
    outer = definitions["outer"]
    assert outer["description"] == "What is outside."
    assert outer["required"] == ["color", "parts", "names", "kind"]
    assert outer["properties"]["color"] == {"enum": ["red"], "description": "Its color."}
    assert outer["properties"]["kind"] == {"enum": ["a", "b"], "description": "What it is."}
    assert outer["properties"]["parts"]["items"] == {"$ref": "#/$defs/Inner"}
    assert definitions["Inner"]["properties"]["length"]["anyOf"] == [{"type": "number"}, {"type": "null"}]


class MeasuredPairs(Record):
    """A record that code computes with, too."""

    num: Annotated[int, "How many."]
    values: tuple[float, ...] = ()
    """What they are."""


def test_a_field_without_a_sentence_stands_in_no_json():
    measured = MeasuredPairs(num=2, values=(0.5, 1.5))
    assert measured.values == (0.5, 1.5)
    assert measured.summary() == plain(measured) == {"num": 2}
    assert MeasuredPairs.taken_from(measured) == measured
    definitions = {}
    schema_of(MeasuredPairs, definitions, {})
    assert (
        [*definitions["MeasuredPairs"]["properties"]] == definitions["MeasuredPairs"]["required"] == ["num"]
    )
