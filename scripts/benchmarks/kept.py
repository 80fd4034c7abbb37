"""Answers kept while a long comparison runs, so that an interrupted one goes on: one JSON file.

The file belongs to settings; answers of other settings are never mixed in. Each answer is written as soon as
it is there, with the load of the machine at that time.
"""

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any


class KeptAnswers:
    """Answers by name, in a file or, without one, in memory only."""

    def __init__(self, file: Path | None, settings: dict[str, Any]) -> None:
        """Read what an earlier run of the same settings left.

        Raises:
            ValueError: if the file belongs to other settings.
        """
        self._file = file
        self._kept: dict[str, Any] = {"settings": settings, "answers": {}, "loads": []}
        if file is None or not file.exists():
            return
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["settings"] != settings:
            raise ValueError(f"{file} holds answers of other settings; delete it or give another --cache")
        self._kept = kept

    def __contains__(self, name: str) -> bool:
        return name in self._kept["answers"]

    def get(self, name: str, ask: Callable[[], Any]) -> dict[str, Any]:
        """Return the fields of the answer kept under a name, or ask for it, a dataclass, and keep it."""
        answers: dict[str, dict[str, Any]] = self._kept["answers"]
        if name not in answers:
            answers[name] = asdict(ask())
            self._kept["loads"].append(round(os.getloadavg()[0], 1))
            self._write()
        return answers[name]

    @property
    def loads(self) -> tuple[float, ...]:
        """Load averages (1 min) after each answer."""
        return tuple(self._kept["loads"])

    def _write(self) -> None:
        if self._file is None:
            return
        self._file.parent.mkdir(parents=True, exist_ok=True)
        partial = self._file.with_name(f".{self._file.name}.partial")
        partial.write_text(json.dumps(self._kept, indent=1), encoding="utf-8")
        partial.replace(self._file)
