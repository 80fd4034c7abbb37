"""How results draw the page that they show in notebooks: the report, made when it is asked for."""

from sfm_shapefit.facts.notebook import draw_pages_by
from sfm_shapefit.facts.result import GraphResult, LocateResult


def draw_page(found: LocateResult | GraphResult) -> str:
    """Return the page of a result's report."""
    from sfm_shapefit.report.page import report_html
    from sfm_shapefit.report.read_back import draw_result

    return report_html(draw_result(found), found.summary())


draw_pages_by(draw_page)
