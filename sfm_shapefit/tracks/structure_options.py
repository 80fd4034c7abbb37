"""Which 3D points join the view graph, and what those of the output must satisfy. Pure data, cheap."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option

PointNodes = Literal["auto", "never", "always"]

_MAX_CAMERAS_WITH_POINTS = 5_000  # cameras; with more, the points would multiply the time of the solve


@explained
@dataclass(frozen=True, kw_only=True)
class NodeOptions(Settings):
    """3D points in the view graph."""

    points: PointNodes = option(
        "auto",
        "3D points as extra nodes of the view graph: a few tracks per camera, whose rays fix what "
        'directions between cameras cannot, above all on straight roads. "auto" uses them up to 5,000 '
        "cameras, from 1,000 on only where pairs do not hold nearly all cameras.",
    )

    def uses_points(self, num_cameras: int) -> bool:
        """Return whether 3D points join the view graph of `num_cameras` cameras."""
        return self.points == "always" or (self.points == "auto" and num_cameras <= _MAX_CAMERAS_WITH_POINTS)

    def points_statement(self, num_cameras: int, num_points: int) -> str:
        """Say whether 3D points join the view graph of `num_cameras` cameras, and why."""
        if self.points == "never":
            return "no, as asked"
        if self.points == "always":
            return f"{num_points} tracks join as nodes, as asked"
        limit = f"{_MAX_CAMERAS_WITH_POINTS:,}"
        if not self.uses_points(num_cameras):
            return f"no: more than {limit} cameras, where they would multiply the time of the solve"
        if not num_points:
            return "no: the pairs hold the cameras, or no three cameras see a point together"
        return f"{num_points} tracks join as nodes: with at most {limit} cameras they cost little"


@explained
@dataclass(frozen=True, kw_only=True)
class StructureOptions(Settings):
    """What a 3D point must satisfy to be in the output."""

    max_reprojection_error_px: float = option(
        4.0, "Observations with a larger reprojection error are removed, and points that lose all but one."
    )
    min_triangulation_angle_deg: float = option(
        1.5, "Points that no two cameras see under at least this angle are removed; their depth means little."
    )
    min_track_length: int = option(2, "Points seen in fewer images than this are removed; 2 or more.")
    min_points_per_image: int = option(
        0,
        "Images that see fewer points than this are left out of the output and listed with the reason; 0 "
        "keeps all. A wrong pose finds a few; where 15 keypoints see points of two others, half suffice.",
    )
    ignore_two_view_tracks: bool = option(
        True,
        "Make no points of matches that only two images share: a wrong one is not noticed, since one "
        "epipolar constraint is all that checks it. The adjustment moves cameras by them all the same, "
        "through a robust loss. Concerns matches of a database, not a model's own tracks, "
        "and only models of three images or more: two have no other matches.",
    )

    def fewest_views(self, num_images: int) -> int:
        """Return how many images must share a match of a database before it may make a point, 2 or 3."""
        return 3 if self.ignore_two_view_tracks and num_images >= 3 else 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_range("max_reprojection_error_px", 1e-6, 1e6)
        self.check_range("min_triangulation_angle_deg", 0.0, 89.9)
        self.check_range("min_track_length", 2)
        self.check_range("min_points_per_image", 0)
