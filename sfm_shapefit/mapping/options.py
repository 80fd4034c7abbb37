"""What `map` is told: `MapOptions`, those of `locate` and a few of its own. Cheap to import."""

from dataclasses import dataclass
from typing import Literal, get_args

from sfm_shapefit.options import LocateOptions

Relative = Literal["matches", "stored"]

LEAST_MATCHES = 15
"""Pairs with fewer verified matches are never used; COLMAP's own limit."""


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
