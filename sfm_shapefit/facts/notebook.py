"""What a result shows in a notebook: its verdict and figures, and its report, scene and all, in a frame.

The report is drawn by a layer above this one, which says here how.
"""

import html
from collections.abc import Callable, Iterable
from typing import Any

_MOST_BYTES = 8_000_000
"""A notebook that holds a larger page opens slowly."""
_COLORS = {"good": "#2e7d32", "look": "#b26a00", "do not use": "#c62828"}
_FRAME_HEIGHT_PX = 720

_drawers: list[Callable[[Any], str]] = []


def draw_pages_by(draw: Callable[[Any], str]) -> None:
    """Let a function draw the page that a result shows in a notebook."""
    _drawers[:] = [draw]


def notebook_html(found: Any, rows: Iterable[tuple[str, str]]) -> str:
    """Return the verdict on a result, a table of rows, and the page of its report.

    Names in them come from strangers, and are escaped; the page runs in a frame that can reach nothing.

    Args:
        found: a result with a `verdict`.
        rows: labels and texts.
    """
    color = _COLORS[found.verdict.grade.value]
    cells = "".join(
        f"<tr><th style='text-align:left'>{html.escape(label)}</th>"
        f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
        for label, text in rows
    )
    verdict = f"<b style='color:{color}'>{html.escape(found.verdict.statement)}</b>"
    return f"<div>{verdict}<table>{cells}</table>{_frame(found)}</div>"


def _frame(found: Any) -> str:
    """Return the page of the report in a frame, or nothing where it is too large, or nobody draws it."""
    page = _drawers[0](found) if _drawers else ""
    if not page or len(page) > _MOST_BYTES:
        return ""
    return (
        f"<iframe sandbox='allow-scripts' style='width:100%;height:{_FRAME_HEIGHT_PX}px;border:0' "
        f'srcdoc="{html.escape(page, quote=True)}"></iframe>'
    )
