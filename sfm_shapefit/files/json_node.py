"""JSON files whose values know where they stand, for messages."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.lines import text_of

_LARGEST = 1e100  # absolute value of a number; squares of larger ones overflow, so these count as infinite


def read_json(file: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: if it cannot be read, naming line and column of what is no JSON.
    """
    try:
        return json.loads(text_of(file))
    except json.JSONDecodeError as error:
        raise InputError(
            f"{file}, line {error.lineno}, column {error.colno}: no JSON ({error.msg}); write the file again"
        ) from error
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, endless brackets
        raise InputError(f"{file} is not a readable JSON file ({error})") from error


@dataclass(frozen=True, slots=True)
class JsonNode:
    """A value of a JSON file."""

    file: Path
    where: str
    value: Any

    def get(self, key: str) -> "JsonNode":
        """Return the value of a key that must be there."""
        if not isinstance(self.value, dict) or key not in self.value:
            raise self.error(f"has no key {key!r}")
        return JsonNode(self.file, f"{self.where}/{key}", self.value[key])

    def has(self, key: str) -> bool:
        """Return whether this is an object with that key."""
        return isinstance(self.value, dict) and key in self.value

    def items(self) -> "list[tuple[str, JsonNode]]":
        """Return keys and values of an object."""
        if not isinstance(self.value, dict):
            raise self.error("is no JSON object")
        return [(key, JsonNode(self.file, f"{self.where}/{key}", v)) for key, v in self.value.items()]

    def elements(self) -> "list[JsonNode]":
        """Return the elements of a list."""
        if not isinstance(self.value, list):
            raise self.error("is no list")
        return [JsonNode(self.file, f"{self.where}[{k}]", v) for k, v in enumerate(self.value)]

    def text(self) -> str:
        """Return a string that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            raise self.error("is no text")
        return self.value

    def number(self) -> float:
        """Return a finite number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.error("is no number")
        if not abs(self.value) <= _LARGEST:  # false for NaN
            raise self.error("is not finite")
        return float(self.value)

    def numbers(self, count: int) -> list[float]:
        """Return a list of so many finite numbers."""
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.error(f"is no list of {count} numbers")
        return [node.number() for node in self.elements()]

    def integer(self) -> int:
        """Return a whole number."""
        number = self.number()
        if number != int(number):
            raise self.error("is no whole number")
        return int(number)

    def error(self, what: str) -> InputError:
        """Return the error that names file and key."""
        return InputError(f"{self.file}: {self.where.lstrip('/') or 'the file'} {what}")
