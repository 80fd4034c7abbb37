"""What `locate` and `map` are told. The fields are the command line's flags and the keys of its TOML.

Pure data, and cheap to import. Each option is stated once, by the stage that it belongs to; `locate` has
the options of all its stages, and some that concern the whole.
"""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.colmap.structure_options import StructureOptions
from sfm_shapefit.directions.options import DirectionOptions
from sfm_shapefit.refinement.options import PlacementOptions, Scale
from sfm_shapefit.settings import explained, option

Points = Literal["auto", "never", "always"]
Source = Literal["auto", "matches", "relative-poses", "tracks"]
Relative = Literal["matches", "stored"]
Rotations = Literal["auto", "measured"]

LEAST_MATCHES = 15
"""Pairs with fewer verified matches are never used by `map`; COLMAP's own limit."""

FIX_SOLVED = "solved"
"""In place of a file of names: fix every image that observes a 3D point of the input."""

# With more cameras, the points would multiply the time of the solve.
_MAX_CAMERAS_WITH_POINTS = 5_000


@explained
@dataclass(frozen=True, kw_only=True)
class LocateOptions(PlacementOptions, DirectionOptions, StructureOptions):
    """The run of `locate` as a whole."""

    directions: Source = option(
        "auto",
        "Where directions come from: the database's inlier matches, its stored relative poses, or the "
        'model\'s own tracks; "auto" takes matches if there is a database, else tracks.',
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
    known_distance: tuple[str, str, float] | None = option(
        None, "Two images by name, and how far apart they are in the output's units."
    )
    fix: str = option(
        "",
        "Cameras that stay exactly where the input has them, while the others are placed around them: "
        'a text file with one image name per line, or "solved": every image that observes a 3D point '
        "of the input, for new images in a solved model. With two or more the scale is theirs, with "
        "one only the origin.",
    )
    refine_with_priors: bool = option(
        False,
        "Let the position priors that set the scale also pull the cameras, each by its standard "
        "deviation; priors that are far off have no part.",
    )
    rotations: Rotations = option(
        "auto",
        'What is thought of the given rotations: "auto" asks the matches which cameras are turned; '
        '"measured", as by instruments, are not doubted.',
    )
    refine_rotations: bool = option(
        False,
        "Refine the given rotations on the matches before cameras are placed, camera by camera where "
        "there is evidence. For rotations from averaging; those that went through bundle adjustment "
        "are finer already.",
    )
    bundle_adjust: bool = option(
        False, "Refine poses and points by bundle adjustment from the seed; intrinsics stay fixed."
    )
    min_trust: float = option(
        0.6,
        "Cameras of less trust are left out of the output and listed with the reason; 0 keeps all. "
        "See the column trust of cameras.csv.",
    )
    max_memory_mb: int = option(
        0,
        "Peak memory to stay below, 0 for no limit: smaller batches, then fewer helpers, see `inspect`. If "
        "nothing is enough, the run is refused with the number needed.",
        also="max_memory",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_distance()
        self.check_range("min_trust", 0.0, 1.0)
        self.check_range("max_memory_mb", 0)
        if self.refine_rotations and self.directions == "relative-poses":
            raise ValueError("refine_rotations works on matches; leave out directions=relative-poses")
        if self.refine_rotations and self.rotations == "measured":
            raise ValueError("rotations that were measured are not refined; leave out one of the two")
        if self.refine_with_priors and self.scale not in ("auto", "prior"):
            raise ValueError(f"refine_with_priors has no effect with the scale {self.scale}; leave out one")
        if (
            self.max_rotation_error_deg != DirectionOptions.max_rotation_error_deg
            and self.directions != "relative-poses"
        ):
            raise ValueError("max_rotation_error_deg belongs to directions=relative-poses; leave out one")

    def _check_distance(self) -> None:
        """Refuse a known distance that is none, or that the scale asked for has no use for."""
        known = self.known_distance
        if self.scale == "distance" and known is None:
            raise ValueError("the scale distance needs known_distance: two image names and their distance")
        if known is None:
            return
        if self.scale not in ("auto", "distance"):
            raise ValueError(f"known_distance has no effect with the scale {self.scale}; leave out one")
        is_number = len(known) == 3 and isinstance(known[2], int | float)
        if not (is_number and isinstance(known[0], str) and isinstance(known[1], str)):
            raise ValueError(f"known_distance must be two image names and a number, got {known!r}")
        if not 0.0 < known[2] < float("inf") or known[0] == known[1]:
            raise ValueError(f"known_distance must be positive, of two different images, got {known!r}")

    def uses_points(self, num_cameras: int) -> bool:
        """Return whether 3D points join the view graph of so many cameras."""
        return self.points == "always" or (self.points == "auto" and num_cameras <= _MAX_CAMERAS_WITH_POINTS)

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


@explained
@dataclass(frozen=True, kw_only=True)
class MapOptions(LocateOptions):
    """What `map` does before it locates."""

    min_points_per_image: int = option(
        30,
        "Images that see fewer points than this are left out of the output and listed with the reason; 0 "
        "keeps all. Even a wrong pose finds a few points.",
    )
    adjust: bool = option(
        True,
        "Adjust a first placement together with its rotations on few tracks that cover the images, and "
        "locate from there. Averaged rotations are far coarser.",
    )
    relative_rotations: Relative = option(
        "matches",
        "Relative rotations to be averaged: estimated from each pair's inlier matches, or those the "
        "database stores, which is faster but less exact and keeps more false pairs.",
        also="relative",
    )
    min_matches: int = option(
        0,
        "Pairs with fewer inlier matches are left out of the averaging. 0 tries 15, 20, 30, 50 and 80 "
        "and keeps the rotations that the matches agree with most.",
    )
    min_model_size: int = option(3, "Components with fewer images make no model.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.directions == "tracks":
            raise ValueError("a database has no tracks; directions must be auto, matches or relative-poses")
        if self.rotations == "measured":
            raise ValueError("map makes rotations from the matches; rotations=measured is for locate")
        if self.min_matches:
            self.check_range("min_matches", LEAST_MATCHES)
        self.check_range("min_model_size", 3)
