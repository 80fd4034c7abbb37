"""What `locate` and `map` are told. The fields are the command line's flags and the keys of its TOML.

Pure data, and cheap to import. Each option is stated once, by the stage that it belongs to; `locate` has
the options of all its stages, and some that concern the whole.
"""

from dataclasses import dataclass
from typing import Any, Literal

from sfm_shapefit.base.settings import explained, option
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.relative_rotations import LEAST_MATCHES
from sfm_shapefit.refinement.options import PlacementOptions, Scale
from sfm_shapefit.rotations.options import Sequencing
from sfm_shapefit.tracks.options import StructureOptions

Rotations = Literal["auto", "held", "free"] | float
Points = Literal["auto", "never", "always"]
Source = Literal["auto", "matches", "tracks"]
KnownDistance = tuple[str, str, float]
IntrinsicsFreedom = Literal["auto", "held", "focal", "all"]
RigFreedom = Literal["held", "free"]
Join = Literal["never", "safe"]
Adjust = Literal["none", "seed", "full"]


FIX_SOLVED = "solved"
"""In place of a file of names: fix every image that observes a 3D point of the input."""

GRAVITY_OF_DATABASE = "database"
"""In place of a file: the gravity of the database's pose priors."""

# With more cameras, the points would multiply the time of the solve.
_MAX_CAMERAS_WITH_POINTS = 5_000
# With more cameras, the adjustment would take longer than all the rest.
_MOST_ADJUSTED_CAMERAS = 2_000


@explained
@dataclass(frozen=True, kw_only=True)
class LocateOptions(PlacementOptions, DirectionOptions, StructureOptions):
    """The run of `locate` as a whole."""

    directions: Source = option(
        "auto",
        "Where directions come from: the database's inlier matches, or the model's own tracks; "
        '"auto" takes matches if there is a database, else tracks.',
    )
    points: Points = option(
        "auto",
        "3D points as extra nodes of the view graph: a few tracks per camera, whose rays fix what "
        'directions between cameras cannot, above all on straight roads. "auto" uses them up to 5,000 '
        "cameras.",
    )
    scale: Scale = option(
        "auto",
        'Scale and origin of the output: "input" takes those of the input\'s centers ("unit" where it '
        'has none); "unit" puts the centroid at 0 and the median distance from it at 1; "prior" maps '
        'onto position priors, axes too; "distance" makes a known distance true; "rig" is the unit of '
        'the sensors\' offsets in their rigs. "auto": a known distance if one is given, else priors if '
        'a table is given, else "input". A model with rigs of several cameras always has their scale, '
        "and one with two or more fixed cameras theirs.",
    )
    known_distance: tuple[KnownDistance, ...] = option(
        (),
        "Two images by name, and how far apart they are in the output's units. May be repeated: of several "
        "the scale is a robust fit, and each is told with what the model has.",
    )
    control_points: str = option(
        "",
        "Ground control points, which set scale, origin and axes: a gcp_list.txt as of OpenDroneMap, whose "
        "first line names the projection, and whose others are x y z, pixels, image, name of the point.",
    )
    fix: str = option(
        "",
        "Cameras that stay exactly where the input has them, while the others are placed around them: "
        'a text file with one image name per line, or "solved": every image that observes a 3D point '
        "of the input, for new images in a solved model. With two or more the scale is theirs, with "
        "one only the origin.",
    )
    without: str = option(
        "",
        "Pairs that are left out, as wrong ones of repeated structure: a file with the names of two images "
        "per line, as pairs.csv or doubtful_pairs.csv has them.",
    )
    refine_with_priors: bool = option(
        False,
        "Let the position priors that set the scale also pull the cameras, each by its standard "
        "deviation; priors that are far off have no part.",
    )
    adjust: Adjust = option(
        "seed",
        'What is adjusted to the pixels: "seed", the placed cameras by all tracks at once, and rotations as '
        "far as they are doubtful, up to 2,000 cameras and not with objectives that deliver an optimum as it "
        'is; "full", poses and points once more by bundle adjustment from the seed; "none", nothing.',
    )
    rotations: Rotations = option(
        "auto",
        'What to make of the given rotations: "held", as measured by instruments, and not doubted; "free", '
        "forgotten by the adjustment; a number, pulled to by that standard deviation about each axis in "
        'degrees; "auto" asks the matches how far off they are, and which cameras are turned.',
    )
    intrinsics: IntrinsicsFreedom = option(
        "auto",
        'Intrinsics that the adjustments change: "auto", focal length and distortion of cameras that were '
        'never calibrated (COLMAP\'s guess, or EXIF data); "focal", the focal lengths of all cameras; "all", '
        'their distortion too; "held", nothing. What was given pulls by its own weight, and stays where the '
        "matches do not tell it. Cameras that images share stay shared.",
    )
    rigs: RigFreedom = option(
        "held",
        'Where sensors stand in their rigs: "held", where they are; "free", the adjustments change it, each '
        "by one pose for all frames. The reference sensors stay, and so does the mean distance of the others "
        "from them: the scale is still that of the rigs. Refused where the matches do not tell a sensor's "
        "pose.",
    )
    min_trust: float = option(
        0.6,
        "Cameras of less trust are left out of the output and listed with the reason; 0 keeps all. "
        "See the column trust of cameras.csv.",
    )
    max_memory_mb: int = option(
        0,
        "Peak memory in MB to stay below, 0 for no limit; what is given up for it is said, and `inspect` "
        "forecasts it. If nothing is enough, the run is refused with the number needed.",
        also="max_memory",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_distance()
        self._check_control_points()
        self._check_rotations()
        self.check_range("min_trust", 0.0, 1.0)
        self.check_range("max_memory_mb", 0)
        if self.intrinsics in ("focal", "all") and self.adjust == "none":
            raise ValueError(f"intrinsics={self.intrinsics} needs an adjustment; leave out adjust=none")
        if self.rigs == "free" and self.adjust == "none":
            raise ValueError("rigs=free needs an adjustment; leave out adjust=none")
        if self.refine_with_priors and self.scale not in ("auto", "prior"):
            raise ValueError(f"refine_with_priors has no effect with the scale {self.scale}; leave out one")

    def _check_rotations(self) -> None:
        """Refuse a standard deviation that is none, and freedom that no adjustment uses."""
        if not isinstance(self.rotations, str) and not 0.0 < self.rotations < 180.0:
            raise ValueError(f"rotations must lie between 0 and 180 degrees, got {self.rotations}")
        if self.rotations not in ("auto", "held") and self.adjust == "none":
            raise ValueError("what rotations are worth matters only to an adjustment; leave out adjust=none")

    def _check_control_points(self) -> None:
        """Refuse what would set the scale beside control points."""
        others = {
            f"the scale {self.scale}": self.scale != "auto",
            "known distances": bool(self.known_distance),
            "position priors": self.refine_with_priors,
            "fixed cameras": bool(self.fix),
        }
        for other, is_asked in others.items():
            if self.control_points and is_asked:
                raise ValueError(f"control points and {other} would both set the scale; leave out one")

    def _check_distance(self) -> None:
        """Refuse a known distance that is none, or that the scale asked for has no use for."""
        known = self.known_distance
        if self.scale == "distance" and not known:
            raise ValueError("the scale distance needs known_distance: two image names and their distance")
        if not known:
            return
        if self.scale not in ("auto", "distance"):
            raise ValueError(f"known_distance has no effect with the scale {self.scale}; leave out one")
        if isinstance(known[0], str):
            known = (known,)
        for one in known:
            _check_one_distance(one)
        object.__setattr__(self, "known_distance", tuple(map(tuple, known)))

    def uses_points(self, num_cameras: int) -> bool:
        """Return whether 3D points join the view graph of so many cameras."""
        return self.points == "always" or (self.points == "auto" and num_cameras <= _MAX_CAMERAS_WITH_POINTS)

    def adjusts_cameras(self, num_cameras: int) -> bool:
        """Return whether placed cameras are adjusted; the optimum as it is, is not."""
        as_found = self.objective not in ("auto", "lud") or not self.refine
        return self.adjust != "none" and not as_found and num_cameras <= _MOST_ADJUSTED_CAMERAS

    def points_statement(self, num_cameras: int, num_points: int) -> str:
        """Say whether 3D points join the view graph of so many cameras, and why."""
        if self.points == "never":
            return "no, as asked"
        if self.points == "always":
            return f"{num_points} tracks join as nodes, as asked"
        limit = f"{_MAX_CAMERAS_WITH_POINTS:,}"
        if not self.uses_points(num_cameras):
            return f"no: more than {limit} cameras, where they would multiply the time of the solve"
        return f"{num_points} tracks join as nodes: at most {limit} cameras, so they cost little"


def _check_one_distance(known: Any) -> None:
    """Refuse what is not two image names and a distance."""
    parts = known if isinstance(known, tuple | list) else ()
    fits = zip(parts, (str, str, int | float), strict=False)
    if len(parts) != 3 or not all(isinstance(part, kind) for part, kind in fits):
        raise ValueError(f"known_distance must be two image names and a number, got {known!r}")
    if not 0.0 < known[2] < float("inf") or known[0] == known[1]:
        raise ValueError(f"known_distance must be positive, of two different images, got {known!r}")


@explained
@dataclass(frozen=True, kw_only=True)
class MapOptions(LocateOptions):
    """What `map` does before it locates."""

    min_points_per_image: int = option(
        30,
        "Images that see fewer points than this are left out of the output and listed with the reason; 0 "
        "keeps all. Even a wrong pose finds a few points.",
    )
    adjust: Adjust = option(
        "seed",
        'What is adjusted to the pixels: "seed", a first placement together with its rotations on few tracks '
        'that cover the images, to locate from there; "full", poses and points once more by bundle '
        'adjustment from the seed; "none", nothing: averaged rotations are far coarser.',
    )
    min_matches: int = option(
        0, "Pairs with fewer inlier matches are left out of the averaging; 0 leaves none out."
    )
    sequence: Sequencing = option(
        "auto",
        "Images that are frames of a video, told by a running number in their names: pairs far apart in time "
        'must agree with the chain of those near in time, or they are left out. "auto" asks that the matches '
        'look like a video too; "names" believes the names; "none" takes all pairs alike.',
    )
    gravity: str = option(
        "",
        "Directions of gravity, which take part in the averaging and turn the model so that z points up: a "
        "text file of name x y z [sigma] per line, in axes of the camera (x right, y down, z ahead; sigma in "
        'degrees, 1 if not given), or "database": those of its pose priors.',
    )
    min_model_size: int = option(3, "Components with fewer images make no model.")
    join: Join = option(
        "safe",
        'Models that stand apart: "safe" joins those that position priors or points seen by both tie '
        'together beyond doubt, with a standard deviation, into a further folder; "never" joins none.',
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.directions == "tracks":
            raise ValueError("a database has no tracks; directions must be auto or matches")
        if self.rotations != "auto":
            raise ValueError(
                "map finds the rotations itself; what given ones are worth is for locate to know"
            )
        if self.fix:
            raise ValueError("a database has no positions that cameras could stay at; fix is for locate")
        if self.min_matches:
            self.check_range("min_matches", LEAST_MATCHES)
        self.check_range("min_model_size", 3)
