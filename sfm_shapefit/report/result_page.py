"""The page of a result: drawn, with pictures and their matches where these are given."""

from collections.abc import Collection
from contextlib import ExitStack, suppress
from datetime import date
from pathlib import Path
from typing import Any

from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.facts.check_result import CheckResult
from sfm_shapefit.facts.map_result import JoinedModel, MapResult
from sfm_shapefit.facts.result import GraphResult, LocateResult
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.report.drawing import Drawing
from sfm_shapefit.report.matched import DrawnMatches, pick_matches
from sfm_shapefit.report.page import Occasion, Pictures, report_html, write_report
from sfm_shapefit.report.results import draw_checked, draw_joined, draw_result
from sfm_shapefit.report.thumbnails import read_thumbnails
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import Matches
from sfm_shapefit.tracks.structure_options import StructureOptions


def draw_page(found: Any) -> str:
    """Return the page of a result, as a notebook shows it."""
    return report_html(_drawing_of(found), found.facts)


def _drawing_of(found: Any) -> Drawing:
    if isinstance(found, JoinedModel):
        return draw_joined(found)
    if isinstance(found, CheckResult):
        return draw_checked(found)
    return draw_result(found)


def write_result_page(found: Any, page: Path, images: Path | str, out: str = "OUT") -> bool:
    """Write a report, of several models that of the largest; False if pictures were asked for in vain."""
    shown = found.models[0] if isinstance(found, MapResult) else found
    drawing = _drawing_of(shown)
    occasion = Occasion(out, day=date.today().isoformat())
    if not str(images):
        write_report(drawing, shown.facts, page, occasion=occasion)
        return True
    small = read_thumbnails(Path(images), drawing.cameras.names, drawing.cameras.trust)
    pictures = Pictures(small, _matches_between(shown, drawing, small)) if small else None
    occasion = occasion._replace(images=str(images)) if small else occasion
    write_report(drawing, shown.facts, page, pictures, occasion)
    return bool(small)


def _matches_between(found: Any, drawing: Drawing, pictures: Collection[int]) -> DrawnMatches | None:
    """Return the matches between pictures, of the database or else of the model's points.

    None where there are none, or the database cannot be read any more.
    """
    if isinstance(found, GraphResult):
        return None
    with suppress(ShapeFitError), ExitStack() as stack:
        database = found.facts.inputs.database
        if database and isinstance(found, LocateResult):
            images: Images = found.placed
            matches: Matches = open_database(database, images.names)
        else:
            model = read_model(found)
            images = model.images
            matches = open_database(database, images.names) if database else TrackMatches(model)
        stack.callback(matches.close)
        structure = found.options.structure if isinstance(found, LocateResult) else StructureOptions()
        limit_px = structure.max_reprojection_error_px
        return pick_matches(drawing.cameras, drawing.pairs, matches.at(images), pictures, limit_px)
    return None
