"""What `locate` is told: `LocateOptions`, whose fields are the command line's flags and the TOML's keys.

Pure data, and cheap to import. Each stage's own options check the values that belong to it.
"""

import os
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal, get_args, get_type_hints

from sfm_shapefit.placement.gauge import Scale
from sfm_shapefit.refinement.options import Filter, Objective
from sfm_shapefit.solver.options import Method

if TYPE_CHECKING:
    from sfm_shapefit.colmap.structure import StructureOptions
    from sfm_shapefit.directions import DirectionOptions
    from sfm_shapefit.refinement.options import PlacementOptions

Points = Literal["auto", "never", "always"]
Source = Literal["auto", "matches", "relative-poses", "tracks"]
Relative = Literal["matches", "stored"]

LEAST_MATCHES = 15
"""Pairs with fewer verified matches are never used by `map`; COLMAP's own limit."""

FIX_SOLVED = "solved"
"""In place of a file of names: fix every image that observes a 3D point of the input."""

MAX_THREADS = 256
"""Threads that may be asked for; work is cut into as many shares, so that millions would never end."""

_MAX_CAMERAS_WITH_POINTS = 5_000  # beyond, the points would multiply the time of the solve


@dataclass(frozen=True, slots=True, kw_only=True)
class LocateOptions:
    """Settings of `locate`, whose docstring has them as a table; what each does stands under its field."""

    directions: Source = "auto"
    """Where directions come from: the database's inlier matches, its stored relative poses, or the
    model's own tracks; "auto" takes matches if there is a database, else tracks."""
    solver: Method = "auto"
    """The ShapeFit solver; "auto" picks one and says which."""
    objective: Objective = "auto"
    """Which program the locations come from. "auto" solves ShapeFit, certified, and LUD, which does not
    collapse on long chains, refines both and keeps the one that fits the angles better; "shapefit" is the
    certified answer itself, unrefined; "lud" takes LUD whatever its fit. "least-squares" and "linf" are
    those baselines' own answers, unrefined and without any certificate, for comparison."""
    filter: Filter = "none"
    """What drops pairs before anything is solved: "1dsfm", those that contradict the order of the cameras
    along random axes; "triangles", those that contradict their triangles. Goes with every objective."""
    refine: bool = True
    """Refine the start robustly in the angles of the directions; only for "auto" and "lud"."""
    points: Points = "auto"
    """3D points as extra nodes of the view graph: a few tracks per camera, whose rays fix what directions
    between cameras cannot, above all on straight roads. "auto" uses them up to 5,000 cameras."""
    tol: float = 1e-8
    """Certified gap at which the solve counts as converged."""
    scale: Scale = "auto"
    """Scale and origin of the output: "input" takes those of the input's centres ("unit" where it has none);
    "unit" puts the centroid at 0 and the median distance from it at 1; "prior" maps onto position priors,
    axes too; "distance" makes a known distance true; "rig" is the unit of the sensors' offsets in their rigs.
    "auto": a known distance if one is given, else priors if a table is given, else "input". A model with
    rigs of several cameras always has their scale, and one with two or more fixed cameras theirs."""
    known_distance: tuple[str, str, float] | None = None
    """Two images by name, and how far apart they are in the output's units."""
    fix: str = ""
    """Cameras that stay exactly where the input has them, while the others are placed around them: a text
    file with one image name per line, or "solved": every image that observes a 3D point of the input, for new
    images in a solved model. With two or more the scale is theirs, with one only the origin."""
    refine_with_priors: bool = False
    """Let the position priors that set the scale also pull the cameras, each by its standard deviation;
    priors that are far off have no part."""
    min_inliers: int = 15
    """Least number of inlier matches of a pair, with parallax and in front of both cameras."""
    min_inlier_ratio: float = 0.5
    """Least share of a pair's matches that must agree with the given rotations."""
    inlier_threshold_px: float = 2.0
    """Largest Sampson error of an inlier match in pixels."""
    refine_rotations: bool = False
    """Refine the given rotations on the matches before cameras are placed, camera by camera where there is
    evidence. For rotations from averaging; those that went through bundle adjustment are finer already."""
    max_reprojection_error_px: float = 4.0
    """Observations of 3D points with a larger reprojection error are dropped."""
    min_triangulation_angle_deg: float = 1.5
    """3D points seen under a smaller angle are dropped."""
    bundle_adjust: bool = False
    """Refine poses and points by bundle adjustment from the seed; intrinsics stay fixed."""
    min_trust: float = 0.6
    """Cameras of less trust are left out of the output and listed with the reason; 0 keeps all. See the
    column trust of cameras.csv."""
    factor_memory: int = 2000
    """What one sparse factor may take, in MB. Larger ones are replaced by iterations in the solve, and left
    out elsewhere: on long chains in the refinement, and for standard deviations."""
    max_memory: int = 0
    """Peak memory in MB to stay below, 0 for no limit: smaller batches, then fewer helpers, see `inspect`. If
    nothing is enough, the run is refused with the number needed."""
    threads: int = 0
    """Threads to use, at most 256; 0 means one per core. The answer does not depend on it."""

    def __post_init__(self) -> None:
        self._check_types()
        kinds = {
            "directions": Source,
            "scale": Scale,
            "solver": Method,
            "objective": Objective,
            "filter": Filter,
            "points": Points,
        }
        for name, kind in kinds.items():
            choices = get_args(kind)
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        self._check_distance()
        if not 0.0 <= self.min_trust <= 1.0:
            raise ValueError(f"min_trust must lie in [0, 1], got {self.min_trust}")
        if self.refine_rotations and self.directions == "relative-poses":
            raise ValueError("refine_rotations works on matches; leave out directions=relative-poses")
        if self.refine_with_priors and self.scale not in ("auto", "prior"):
            raise ValueError(f"refine_with_priors has no effect with the scale {self.scale}; leave out one")
        if not 0 <= self.threads <= MAX_THREADS:
            raise ValueError(f"threads must lie in [0, {MAX_THREADS}], got {self.threads}")
        if self.max_memory < 0:
            raise ValueError(f"max_memory must be 0 or more, got {self.max_memory}")
        self.for_placement()
        self.for_directions()
        self.for_structure()

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

    def _check_types(self) -> None:
        """Refuse values of another type by name; an integer serves as a float."""
        hints = get_type_hints(type(self))
        for item in fields(self):
            value, wanted = getattr(self, item.name), hints[item.name]
            if item.name == "known_distance":
                if not isinstance(value, tuple | list | None):
                    raise ValueError(f"known_distance must be two image names and a number, got {value!r}")
                continue
            accepted = {float: (float, int), int: (int,), bool: (bool,)}.get(wanted, (str,))
            if not isinstance(value, accepted) or (isinstance(value, bool) and wanted is not bool):
                raise ValueError(f"{item.name} must be of type {accepted[0].__name__}, got {value!r}")

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

    def for_placement(self) -> "PlacementOptions":
        """Return the share of the solver and of what follows it."""
        from sfm_shapefit.refinement.options import PlacementOptions

        return PlacementOptions(
            method=self.solver,
            tol=self.tol,
            factor_memory=self.factor_memory,
            threads=self.num_threads(),
            objective=self.objective,
            filter=self.filter,
            refine=self.refine,
        )

    def for_directions(self) -> "DirectionOptions":
        """Return the direction estimator's share."""
        from sfm_shapefit.directions import DirectionOptions

        return DirectionOptions(
            min_inliers=self.min_inliers,
            min_inlier_ratio=self.min_inlier_ratio,
            inlier_threshold_px=self.inlier_threshold_px,
        )

    def for_structure(self) -> "StructureOptions":
        """Return the triangulation's share."""
        from sfm_shapefit.colmap.structure import StructureOptions

        return StructureOptions(
            max_reprojection_error_px=self.max_reprojection_error_px,
            min_triangulation_angle_deg=self.min_triangulation_angle_deg,
        )

    def num_threads(self) -> int:
        """Return the number of threads to use."""
        return self.threads or min(os.cpu_count() or 1, MAX_THREADS)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions(LocateOptions):
    """Settings of `map`."""

    refine_rotations: bool = True
    """Refine the averaged rotations on the matches before cameras are placed, camera by camera where there
    is evidence. With bundle_adjust a draft is adjusted instead, and its rotations are taken."""
    relative: Relative = "matches"
    """Relative rotations to be averaged: estimated from each pair's inlier matches, or those the database
    stores, which is faster but less exact and keeps more false pairs."""
    min_matches: int = 0
    """Pairs with fewer inlier matches are left out of the averaging. 0 tries 15, 20, 30, 50 and 80 and keeps
    the rotations that the matches agree with most."""
    min_model_size: int = 3
    """Components with fewer images make no model."""

    def __post_init__(self) -> None:
        LocateOptions.__post_init__(self)
        if self.relative not in get_args(Relative):
            raise ValueError(f"relative must be one of matches, stored, got {self.relative!r}")
        if self.directions == "tracks":
            raise ValueError("a database has no tracks; directions must be auto, matches or relative-poses")
        if self.min_matches and self.min_matches < LEAST_MATCHES:
            raise ValueError(f"min_matches must be 0 or at least {LEAST_MATCHES}, got {self.min_matches}")
        if self.min_model_size < 3:
            raise ValueError(f"min_model_size must be at least 3, got {self.min_model_size}")
