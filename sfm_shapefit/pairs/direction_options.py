"""What is asked of a pair before its direction is believed. Pure data, and cheap to import."""

from dataclasses import dataclass

from sfm_shapefit.base.settings import Settings, explained, option

LEAST_MATCHES = 15
"""Pairs with fewer verified matches are never used by `map`; COLMAP's own limit."""


@explained
@dataclass(frozen=True, kw_only=True)
class DirectionOptions(Settings):
    """Which pairs are believed."""

    min_inliers: int = option(
        15, "Least number of inlier matches with parallax whose point lies in front of both cameras."
    )
    min_inlier_ratio: float = option(
        0.5, "Least share of inliers among the pair's matches; repeated facades show up below it."
    )
    max_rival_share: float = option(
        0.5,
        "Largest number of matches that speak for a second direction only, per match that speaks for "
        "the first only; repeated facades and moving things show up above it.",
    )
    min_sign_majority: float = option(
        5.0, "Points in front of both cameras must outnumber those behind both by this factor."
    )
    max_sigma_deg: float = option(
        10.0, "Largest standard deviation of the direction; beyond it there is no parallax to speak of."
    )
    inlier_threshold_px: float = option(
        2.0,
        "Largest Sampson error of an inlier; a Sampson error of 2 px allows 2.8 px off the epipolar line.",
    )
    num_hypotheses: int = option(200, "Two-match hypotheses per pair.")
    without: str = option(
        "",
        "Pairs that are left out, as wrong ones of repeated structure: a file with the names of two images "
        "per line, as pairs.csv or doubtful_pairs.csv has them.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_range("min_inliers", 2)
        self.check_range("min_inlier_ratio", 0.0, 1.0)
        self.check_range("max_rival_share", 0.0)
        self.check_range("min_sign_majority", 1.0)
        self.check_range("max_sigma_deg", 1e-6, 90.0)
        self.check_range("inlier_threshold_px", 1e-3)
        self.check_range("num_hypotheses", 1, 10_000)
