"""How results show themselves: one line in a console, a table or their report in a notebook, plain for JSON.

Folders and reports are written by a layer above this one, which the package names here.
"""

import html
import re
import shlex
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

_MOST_TEXT = 300  # characters; a longer value of a table is counted instead
_MOST_BYTES = 8_000_000
"""Bytes of the page of a notebook, at most; a notebook that holds a larger one opens slowly."""
_COLORS = {"good": "#2e7d32", "look": "#b26a00", "cannot be judged": "#b26a00", "do not use": "#c62828"}
_FRAME_HEIGHT_PX = 720  # pixels; as high as a notebook shows at once


class Row(NamedTuple):
    """A label, and what is told under it, a line each; without lines nothing is told."""

    label: str
    lines: Sequence[str]


def row(label: str, text: str) -> Row:
    """Return a row of one line, or of none if the text is empty."""
    return Row(label, [text] if text else [])


class NextStep(NamedTuple):
    """What to do next, and the command that does it.

    In the command, {images} stands for the folder of the images, {out} for that of the result, and
    {out_dense} for one beside it.
    """

    text: str
    command: str
    condition: str = ""
    """When to do it, a clause; empty for at once."""

    @property
    def line(self) -> str:
        """What the terminal says of it; the command stands last, so that it can be copied."""
        return f"next{self.condition and f', {self.condition}'}: {self.command}"

    def at(self, **folders: Path | str) -> "NextStep":
        """Return the step with some folders in place of the words that stand for them."""

        def quoted(word: re.Match[str]) -> str:
            return shlex.quote(str(folders[word[1]])) if word[1] in folders else word[0]

        return self._replace(command=re.sub(r"\{(\w+)\}", quoted, self.command))


class Telling(NamedTuple):
    """What is told of a result in a terminal."""

    lines: Sequence[str]
    """The answer: how much is placed, where matches came from, how well it is known; a line each."""
    rows: Sequence[Row] = ()
    """What is out of the ordinary: what is not placed and why, lenses, warnings."""
    details: Sequence[Row] = ()
    """What `--verbose` adds."""
    elsewhere: str = "see locate.json"
    """Where lines stand that are too many to be shown."""
    step: NextStep = NextStep("", "")
    folders: tuple[str, ...] = (".",)
    """The folders in OUT that have a report; the next step is about the first."""


class Displayed:
    """A result with a one-line `repr`, a `summary`, and a table in notebooks made of it."""

    __slots__ = ()

    def summary(self: Any) -> dict[str, Any]:
        """Return the result in plain values, as it stands in JSON."""
        return dict(self.facts.summary())

    @abstractmethod
    def _headline(self) -> str:
        """Return what matters most, in a few words."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._headline()}>"

    def _repr_html_(self) -> str:
        rows = ((name.replace("_", " "), _text_of(value)) for name, value in self.summary().items())
        return f"<table><caption>{html.escape(repr(self))}</caption>{_table_rows(rows)}</table>"


class Writers(NamedTuple):
    """What writes results."""

    draw: Callable[[Any], str]
    """Returns the page that a result shows in a notebook."""
    page: Callable[..., Path]
    """Writes a page of a result, and returns it."""
    folder: Callable[..., Path]
    """Writes the folder of a result, and returns it."""
    length: Callable[..., Any]
    """Tells how well a length in a result is known."""


def _writers() -> Writers:
    """Return what writes results, by the package's word; it is loaded with the first one that is written."""
    writers: Writers = import_module(__name__.partition(".")[0])._load_writers()
    return writers


class Reported(Displayed):
    """A result that has a report and tells lengths."""

    __slots__ = ()

    def report(self, page: Path | str, *, images: Path | str = "", overwrite: bool = False) -> Path:
        """Write a page that explains the result and works offline, and return its path.

        Args:
            page: the file to be made.
            images: folder of the images, of which the page is to have small pictures.
            overwrite: replace an existing file.

        Raises:
            InputError: if the file exists or cannot be written, or the folder has none of the images.
        """
        return _writers().page(self, page, images=images, overwrite=overwrite)

    def length(self, first: str | int, second: str | int) -> Any:
        """Return the distance of two images or points and how well it is known, see `evaluate_lengths`.

            print(found.length("0001.jpg", "0004.jpg"))  # 2.503 ± 0.004 m (95 %), worst direction ...

        Args:
            first, second: names of images, whose centers are meant, or ids of 3D points.

        Raises:
            InputError: if there is no such image or point, or the result has no model.
            UnsolvableError: if nothing is known of the errors.
        """
        return _writers().length(self, first, second)


class Written(Reported):
    """A result that can be written as the folder that the command would make."""

    __slots__ = ()
    _PUBLIC: ClassVar[tuple[str, ...]] = ()
    """Attributes that completion offers; the others are what the stages of a run left, and may change."""

    def __dir__(self) -> Iterable[str]:
        return sorted({*self._PUBLIC, "facts", "length", "report", "summary", "verdict", "write"})

    def write(self, out: Path | str, **options: Any) -> Path:
        """Write the result into a new or empty folder, which is filled in one step, and return it.

        Args:
            out: the folder: the model, tables, locate.json and report.html.
            **options: of `WriteOptions` by name: `found.write("out", overwrite=True)`.

        Raises:
            InputError: if the folder holds something or cannot be written.
        """
        return _writers().folder(self, out, **options)


def report_in_notebook(found: Any) -> str:
    """Return the verdict on a result, what is told of it, and the page of its report.

    The page runs in a frame that can reach nothing. It is left out where it is too large.
    """
    color, statement = _COLORS[found.verdict.grade.value], html.escape(found.verdict.statement)
    rows = [Row("result", found.told.lines), *found.told.rows]
    told = ((label, "\n".join(lines)) for label, lines in rows if lines)
    table = _table_rows(told, " style='text-align:left;white-space:pre-line'")
    shown = f"<b style='color:{color}'>{statement}</b><table>{table}</table>"
    page = _writers().draw(found)
    if len(page) <= _MOST_BYTES:
        shown += (
            f"<iframe sandbox='allow-scripts' style='width:100%;height:{_FRAME_HEIGHT_PX}px;border:0' "
            f'srcdoc="{html.escape(page, quote=True)}"></iframe>'
        )
    return f"<div>{shown}</div>"


def _table_rows(rows: Iterable[tuple[str, str]], style: str = "") -> str:
    """Return labels and texts as rows of a table; names in them come from strangers, and are escaped."""
    return "".join(
        f"<tr><th{style}>{html.escape(label)}</th><td{style}>{html.escape(text)}</td></tr>"
        for label, text in rows
    )


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
