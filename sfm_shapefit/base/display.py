"""How results show themselves: one line in a console, a table in a notebook, plain values for JSON."""

import html
from abc import abstractmethod
from typing import Any

_MOST_TEXT = 300  # characters; a longer value of a table is counted instead


class Displayed:
    """A result with a one-line `repr`, a `summary`, and a table in notebooks made of it."""

    __slots__ = ()

    @abstractmethod
    def summary(self) -> dict[str, Any]:
        """Return the result in plain values, as it stands in JSON."""

    @abstractmethod
    def _headline(self) -> str:
        """Return what matters most, in a few words."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._headline()}>"

    def _repr_html_(self) -> str:
        """Return a table of the summary; names in it come from strangers, and are escaped."""
        rows = [
            f"<tr><th>{html.escape(name.replace('_', ' '))}</th><td>{html.escape(_text_of(value))}</td></tr>"
            for name, value in self.summary().items()
        ]
        return f"<table><caption>{html.escape(repr(self))}</caption>{''.join(rows)}</table>"


def _text_of(value: Any) -> str:
    """Return a value in readable text; what is long is counted instead."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        text = ", ".join(f"{name} {_text_of(item)}" for name, item in value.items())
    elif isinstance(value, list | tuple):
        text = ", ".join(map(_text_of, value))
    else:
        return str(value)
    return text if len(text) <= _MOST_TEXT else f"{len(value)} entries"
