"""`view`: a live viewer in the browser, with thresholds to move and cameras to pick. The door to viser.

Everything is shown around the median of the cameras, because the viewer computes in float32. Names reach it
as plain labels of its controls, shortened; never as markup.
"""

import io
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.errors import MissingExtraError
from sfm_shapefit.geometry import angle_between_deg, normalized
from sfm_shapefit.report.drawing import Drawing, PairClass, frustum_corners, input_centers
from sfm_shapefit.report.first_screen import banner
from sfm_shapefit.report.mesh import PAIR_COLORS, trust_colors
from sfm_shapefit.report.sentences import shorten

if TYPE_CHECKING:
    import viser

_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
"""Of a pyramid: apex, then corners."""
_GRAY = (140, 140, 140)
_CHOSEN = (240, 180, 40)
_NOBODY = "all cameras"
_MAX_PAIRS = 50_000
# A click means the camera whose center is at most this far off.
_PICKED_DEG = 2.0
_AS_REPORTED = "as in the report"
_LIMITS_DEG = (0.1, 0.3, 1.0, 3.0, 10.0)
# More agreeing pairs are not drawn until they are asked for.
_MANY_PAIRS = 200
# The eye starts so many radii to the right, behind and above; frusta have this share of one at least.
_FIRST_VIEW = 2.6 * np.array([0.35, -0.84, 0.42])
_LEAST_FRUSTUM = 0.05
_POINT_SIZE = 0.004
# The viewer takes colors of lines as linear in light, and would show them pale.
_GAMMA = 2.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Thresholds:
    """What the controls say."""

    residual_deg: float | None
    """Pairs with a larger residual are drawn as contradicting; None: as the report has it."""
    min_support: int
    """Pairs with fewer matches are not drawn."""
    min_trust: float
    """Cameras with less trust are not drawn, nor are their pairs."""
    camera: int | None
    """Only its pairs are drawn; all if None."""


def select_pairs(drawing: Drawing, thresholds: Thresholds) -> tuple[IntArray, BoolArray]:
    """Return the rows of the pairs that are drawn, the worst first, and which contradict by the threshold."""
    cameras, pairs = drawing.cameras, drawing.pairs
    shown = cameras.placed & ~(cameras.trust < thresholds.min_trust)
    kept = shown[pairs.cameras].all(axis=1) & np.isfinite(pairs.residuals_deg)
    kept &= pairs.support >= thresholds.min_support
    if thresholds.camera is not None:
        kept &= (pairs.cameras == thresholds.camera).any(axis=1)
    worst = pairs.worst_first()
    rows = worst[kept[worst]][:_MAX_PAIRS]
    if thresholds.residual_deg is None:
        return rows, pairs.classes[rows] == PairClass.CONTRADICTS
    return rows, pairs.residuals_deg[rows] > thresholds.residual_deg


def camera_at(drawing: Drawing, origin: FloatArray, direction: FloatArray) -> int | None:
    """Return the placed camera whose center is nearest to a ray in angle, within 2 degrees; None if none is.

    Args:
        drawing: what is drawn.
        origin: (3,) of the ray, in the output's units and axes.
        direction: (3,) of any length.
    """
    rows = np.flatnonzero(drawing.cameras.placed)
    towards = drawing.cameras.centers[rows] - origin
    if len(rows) == 0:
        return None
    angles = angle_between_deg(normalized(towards), normalized(np.broadcast_to(direction, towards.shape)))
    nearest = int(np.argmin(angles))
    return int(rows[nearest]) if angles[nearest] <= _PICKED_DEG else None


def serve(drawing: Drawing, facts: dict[str, Any], host: str, port: int) -> "viser.ViserServer":
    """Start the viewer; it runs until its `stop` is called. The facts are those of locate.json.

    At the host 127.0.0.1 it can be reached from this machine only. If the port is taken, it is the next one.

    Raises:
        InputError: if viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError("the viewer", "viser", "viewer") from error
    # The server prints a banner; the address is for the caller to tell.
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.scene.set_up_direction(tuple(drawing.axes[2].tolist()))
    _View(server, drawing, facts)
    return server


def scene_radius(drawing: Drawing) -> float:
    """Return within what distance of the cameras' median most cameras and points lie."""
    centers = drawing.cameras.centers[drawing.cameras.placed]
    if len(centers) == 0:
        return 1.0
    middle = np.median(centers, axis=0)
    cameras = np.linalg.norm(centers - middle, axis=1)
    points = np.linalg.norm(drawing.points.positions - middle, axis=1)
    reach = [np.quantile(cameras, 0.95), *([np.quantile(points, 0.8)] if len(points) else [])]
    return float(max(reach)) or 1.0


class _View:
    """The controls and what they draw."""

    def __init__(self, server: "viser.ViserServer", drawing: Drawing, facts: dict[str, Any]) -> None:
        self._server, self._drawing = server, drawing
        centers = drawing.cameras.centers
        self._middle = (
            np.median(centers[drawing.cameras.placed], axis=0) if drawing.cameras.placed.any() else 0.0
        )
        self._radius = scene_radius(drawing)
        depth = max(drawing.frustum_depth, _LEAST_FRUSTUM * self._radius)
        self._drawing = drawing = replace(drawing, frustum_depth=depth)
        self._by_trust = np.lexsort((drawing.cameras.trust, np.isnan(drawing.cameras.trust)))
        self._scale = 1.0  # of the frusta
        self._look_from_outside()
        self._points = self._add_points()
        self._add_input()
        self._add_controls(facts)
        self._draw()

    def _look_from_outside(self) -> None:
        """Let the first view, and a reset of it, show the whole scene."""
        first = self._server.initial_camera
        first.position = tuple((self._radius * _FIRST_VIEW @ self._drawing.axes).tolist())
        first.look_at = (0.0, 0.0, 0.0)

    def _add_points(self) -> "viser.PointCloudHandle | None":
        points = self._drawing.points
        if len(points.positions) == 0:
            return None
        return self._server.scene.add_point_cloud(
            "/points",
            (points.positions - self._middle).astype(np.float32),
            points.colors.astype(np.uint8),
            point_size=_POINT_SIZE * self._radius,
            point_shape="circle",
            precision="float32",
        )

    def _add_input(self) -> None:
        """Draw the input's cameras in gray where they can be brought into the output's units."""
        self._input = None
        centers = input_centers(self._drawing)
        if centers is not None:
            rows = np.flatnonzero(np.isfinite(centers).all(axis=1))
            self._input = self._frusta("/input", rows, centers[rows], np.tile(_GRAY, (len(rows), 1)))

    def _add_controls(self, facts: dict[str, Any]) -> None:
        gui, drawing = self._server.gui, self._drawing
        placed = int(drawing.cameras.placed.sum())
        total = len(drawing.cameras.names)
        gui.add_markdown(f"**{banner(drawing, facts)['headline']}**")
        gui.add_markdown(f"{placed:,} of {total:,} {drawing.noun}s placed, colored by trust: red 0, green 1")
        self._limits = {_AS_REPORTED: None} | {f"above {limit:g} degrees": limit for limit in _LIMITS_DEG}
        self._residual = gui.add_dropdown("pairs contradict", [*self._limits], initial_value=_AS_REPORTED)
        top = int(drawing.pairs.support.max(initial=0))
        self._support = gui.add_slider("least matches", 0, max(top, 1), 1, 0)
        self._trust = gui.add_slider("least trust", 0.0, 1.0, 0.01, 0.0)
        names = [
            f"{k + 1}: {shorten(drawing.cameras.names[row], 80)}" for k, row in enumerate(self._by_trust)
        ]
        self._picked = gui.add_dropdown("pairs of", [_NOBODY, *names], initial_value=_NOBODY)
        self._choices = {name: int(row) for name, row in zip(names, self._by_trust, strict=True)}
        self._counts = gui.add_text("pairs drawn", "", disabled=True)
        self._add_layers()
        if self._input is not None:
            self._input.visible = False
            handle, shown = self._input, gui.add_checkbox("input's poses (gray)", False)
            shown.on_update(lambda _event: setattr(handle, "visible", shown.value))
        own = (self._residual, self._support, self._trust, self._picked, self._agreeing, self._contradicting)
        for control in (*own, self._size):
            control.on_update(lambda _event: self._draw())
        self._server.scene.on_click()(self._pick)

    def _add_layers(self) -> None:
        """Add what switches layers on and off, and their sizes."""
        gui = self._server.gui
        count = int(np.sum(self._drawing.pairs.classes == PairClass.AGREES))
        self._agreeing = gui.add_checkbox("pairs that agree", count <= _MANY_PAIRS)
        self._contradicting = gui.add_checkbox("pairs that contradict", True)
        self._size = gui.add_slider("frustum size", 0.2, 5.0, 0.1, 1.0)
        points = self._points
        if points is not None:
            shown, size = gui.add_checkbox("points", True), gui.add_slider("point size", 0.2, 5.0, 0.1, 1.0)
            shown.on_update(lambda _event: setattr(points, "visible", shown.value))
            base = _POINT_SIZE * self._radius
            size.on_update(lambda _event: setattr(points, "point_size", base * size.value))

    def _pick(self, event: "viser.SceneClickEvent") -> None:
        """Choose the camera under a click."""
        origin = np.asarray(event.ray_origin) + self._middle
        row = camera_at(self._drawing, origin, np.asarray(event.ray_direction))
        if row is not None:
            self._picked.value = next(name for name, own in self._choices.items() if own == row)

    def _draw(self) -> None:
        """Draw cameras and pairs anew; a name that is drawn again replaces what it named."""
        drawing, self._scale = self._drawing, float(self._size.value)
        chosen = self._choices.get(self._picked.value)
        thresholds = Thresholds(
            residual_deg=self._limits[self._residual.value],
            min_support=int(self._support.value),
            min_trust=float(self._trust.value),
            camera=chosen,
        )
        rows = np.flatnonzero(drawing.cameras.placed & ~(drawing.cameras.trust < thresholds.min_trust))
        colors = trust_colors(drawing.cameras.trust[rows])
        colors[rows == (-1 if chosen is None else chosen)] = _CHOSEN
        self._frusta("/cameras", rows, drawing.cameras.centers[rows], colors)
        drawn, contradicts = select_pairs(drawing, thresholds)
        wanted = np.where(contradicts, self._contradicting.value, self._agreeing.value)
        drawn, contradicts = drawn[wanted], contradicts[wanted]
        kinds = np.where(contradicts, PairClass.CONTRADICTS, PairClass.AGREES)
        self._lines("/pairs", drawing.cameras.centers[drawing.pairs.cameras[drawn]], PAIR_COLORS[kinds])
        against = int(contradicts.sum())
        self._counts.value = f"{len(drawn):,}, {against:,} of them contradict"

    def _frusta(
        self, name: str, rows: IntArray, centers: FloatArray, colors: Any
    ) -> "viser.LineSegmentsHandle | None":
        """Draw cameras as pyramids, those without a rotation as a cross."""
        depth = self._scale * self._drawing.frustum_depth
        corners = frustum_corners(replace(self._drawing, frustum_depth=depth), rows, centers)
        known = np.isfinite(corners).all(axis=(1, 2))
        pyramids = np.concatenate([centers[:, None, :], corners], axis=1)[known][:, _EDGES]
        arms = self._drawing.frustum_depth / 3 * np.stack([-np.eye(3), np.eye(3)], axis=1)
        crosses = centers[~known][:, None, None, :] + arms
        segments = np.concatenate([pyramids.reshape(-1, 2, 3), crosses.reshape(-1, 2, 3)])
        shades = np.concatenate([np.repeat(colors[known], 8, axis=0), np.repeat(colors[~known], 3, axis=0)])
        return self._lines(name, segments, shades)

    def _lines(self, name: str, ends: FloatArray, colors: Any) -> "viser.LineSegmentsHandle | None":
        """Draw lines (k, 2, 3) in colors (k, 3); nothing is left of the name if there are none."""
        if len(ends) == 0:
            self._server.scene.remove_by_name(name)
            return None
        linear = 255.0 * (np.asarray(colors) / 255.0) ** _GAMMA
        both = np.repeat(linear.round().astype(np.uint8)[:, None, :], 2, axis=1)
        points = (ends - self._middle).astype(np.float32)
        return self._server.scene.add_line_segments(
            name, points, both, thickness=2.0, thickness_units="screen"
        )
