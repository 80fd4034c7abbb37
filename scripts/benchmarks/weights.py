"""What the weights of pairs are worth: the same directions solved with them, and with all weights equal.

A pair's weight comes from its covariance and support (`PairDirections.weights`). Solved are the pairs alone,
without 3D points, whose rays would hide much of the effect: ShapeFit's certified optimum, in whose program
the weights stand, and what `place` makes of it with the pairs' covariances. Rotations of real sets are those
of the model, the truth is as in the benchmark `real`; made scenes have wrong matches and wrong pairs.
"""

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.real import SCENES
from harness import ours
from harness.metrics import Check, Quantity, number, numbers, verdict
from harness.record import table_of

if TYPE_CHECKING:
    from sfm_shapefit.arrays import FloatArray
    from sfm_shapefit.directions.pair_directions import PairDirections

MADE = ("ring", "facade", "cloud", "courtyard")
SEEDS = 3

QUANTITIES = (
    Quantity(
        *("ShapeFit, placed", "of the set", "lower", 0.05),
        "median / mean position error of ShapeFit's optimum, and of what is placed, after robust "
        "(L1) alignment, of the largest rigid piece; with equal weights, and with the pairs' own",
    ),
    Quantity(
        *("gain", "1", "higher", 0.05),
        "mean error with equal weights over that with their own, of ShapeFit / of what is placed",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Median and mean position error."""

    shapefit: tuple[float, float]
    placed: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One set with equal weights and with the pairs' own."""

    name: str
    equal: Errors
    weighted: Errors

    @property
    def gains(self) -> tuple[float, float]:
        """How many times smaller the mean error is with weights: of ShapeFit, of what is placed."""
        return (
            self.equal.shapefit[1] / self.weighted.shapefit[1],
            self.equal.placed[1] / self.weighted.placed[1],
        )


def tables(found: Sequence[Comparison]) -> Iterator[str]:
    """Yield the table of the comparisons and what all of them say together."""
    yield table_of(
        found,
        {
            "set": lambda one: one.name,
            "ShapeFit, equal": lambda one: numbers(one.equal.shapefit),
            "ShapeFit, own": lambda one: numbers(one.weighted.shapefit),
            "placed, equal": lambda one: numbers(one.equal.placed),
            "placed, own": lambda one: numbers(one.weighted.placed),
            "gain": lambda one: numbers(one.gains),
        },
    )
    yield _summary("what is placed, all sets", [one.gains[1] for one in found])
    yield _summary("ShapeFit, real sets", [one.gains[0] for one in found if one.name in SCENES])


def _summary(what: str, gains: list[float]) -> str:
    """Return the geometric mean of the gains of some sets against 1, in a sentence."""
    if not gains:
        return f"Gain of {what}: none is there."
    gain = statistics.geometric_mean(gains)
    judged = verdict([Check(name="gain", value=gain, limit=1.0, better="higher")])
    return f"Gain of {what}, geometric mean: {number(gain)}, {judged}."


def compare_real(name: str, folder: Path) -> Comparison:
    """Compare on the directions of a COLMAP model, whose matches are read from its database."""
    import numpy as np
    import pycolmap

    names, directions = ours.directions_of_set(folder)
    known = pycolmap.Reconstruction(folder / SCENES[name].truth)
    center_of = {image.name: image.projection_center() for image in known.images.values() if image.has_pose}
    centers = np.array([center_of.get(image, [np.nan] * 3) for image in names])
    return compare(name, directions, centers)


def compare_made(shape: str, seed: int) -> Comparison:
    """Compare on a made scene of 30 cameras: a tenth of the pairs and a fifth of the matches are wrong."""
    import numpy as np

    from sfm_shapefit.directions.estimate import estimate_directions
    from sfm_shapefit.directions.matches import RayMatches
    from sfm_shapefit.geometry import normalized
    from sfm_shapefit.synthetic import SceneOptions, make_scene

    scene = make_scene(
        SceneOptions(
            shape=shape,  # type: ignore[arg-type]
            num_images=30,
            num_points=1500,
            corrupted_pair_fraction=0.1,
            wrong_match_fraction=0.2,
            max_matches_per_pair=150,
            seed=seed,
        )
    )
    inverse = np.linalg.inv(scene.calibration)
    rays = [
        normalized(np.column_stack([xy, np.ones(len(xy))]) @ inverse.T) @ rotation
        for xy, rotation in zip(scene.keypoints, scene.rotations, strict=True)
    ]
    lists = [scene.matches_of(e) for e in range(scene.num_pairs)]
    rays_i, rays_j = (
        np.concatenate(
            [rays[image][rows[:, side]] for image, rows in zip(scene.pairs[:, side], lists, strict=True)]
        )
        for side in (0, 1)
    )
    matches = RayMatches(
        pairs=scene.pairs,
        offsets=scene.match_offsets,
        rays_i=rays_i,
        rays_j=rays_j,
        pixel_angles=np.full(scene.num_pairs, 1.0 / scene.calibration[0, 0]),
    )
    directions = estimate_directions(matches)
    return compare(f"{shape}, made {seed}", directions, scene.centers)


def compare(name: str, directions: "PairDirections", centers: "FloatArray") -> Comparison:
    """Solve directions with equal weights and with their own; centers (n, 3) are NaN where unknown."""
    own = directions.weights()[directions.usable()]
    return Comparison(
        name=name,
        equal=_errors(directions, own**0, centers),
        weighted=_errors(directions, own, centers),
    )


def _errors(directions: "PairDirections", weights: "FloatArray", centers: "FloatArray") -> Errors:
    """Place the usable directions with weights and compare with the centers."""
    import numpy as np

    from sfm_shapefit import ViewGraph
    from sfm_shapefit.geometry import fit_similarity_l1

    usable = directions.usable()
    graph = ViewGraph(len(centers), directions.pairs[usable], directions.directions[usable], weights)
    placement = ours.place(graph, covariance=directions.covariance[usable])
    true = centers[placement.cameras]
    known = np.isfinite(true).all(axis=1)

    def errors_of(t: "FloatArray") -> tuple[float, float]:
        aligned = fit_similarity_l1(t[known], true[known])
        distances = np.linalg.norm(aligned.apply(t[known]) - true[known], axis=1)
        return float(np.median(distances)), float(np.mean(distances))

    return Errors(shapefit=errors_of(placement.certified.locations), placed=errors_of(placement.locations))
