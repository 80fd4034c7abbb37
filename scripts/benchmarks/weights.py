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

from benchmarks.metrics import Check, Quantity, number, numbers, verdict
from benchmarks.record import table

if TYPE_CHECKING:
    from sfm_shapefit.arrays import FloatArray
    from sfm_shapefit.directions.pair_directions import PairDirections

REAL = {
    "fountain-P11": "gt",
    "Herz-Jesus-P8": "gt",
    "Herz-Jesus-P25": "gt",
    "castle-P19": "gt",
    "castle-P30": "gt",
    "lego100": "gt",
    "liberty": "sparse/0",
    "liberty-calibrated": "sparse/0",
}
MADE = ("ring", "facade", "cloud", "courtyard")
SEEDS = 3

QUANTITIES = (
    Quantity(
        name="ShapeFit, placed",
        unit="of the set",
        better="lower",
        rel_tol=0.05,
        meaning="median / mean position error of ShapeFit's optimum, and of what is placed, after robust "
        "(L1) alignment, of the largest rigid piece; with equal weights, and with the pairs' own",
    ),
    Quantity(
        name="gain",
        unit="1",
        better="higher",
        rel_tol=0.05,
        meaning="mean error with equal weights over that with their own, of ShapeFit / of what is placed",
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


def comparisons(data: Path) -> Iterator[Comparison]:
    """Yield the comparison of every real set that is there, and of the made scenes."""
    for name, truth in REAL.items():
        if (data / name).is_dir():
            yield comparison_of_real(name, data / name, truth)
    for shape in MADE:
        for seed in range(SEEDS):
            yield comparison_of_made(shape, seed)


def section(found: Sequence[Comparison]) -> str:
    """Return the table of the comparisons and what all of them say together."""
    rows = [
        [
            one.name,
            numbers(one.equal.shapefit),
            numbers(one.weighted.shapefit),
            numbers(one.equal.placed),
            numbers(one.weighted.placed),
            numbers(one.gains),
        ]
        for one in found
    ]
    header = ["set", "ShapeFit, equal", "ShapeFit, own", "placed, equal", "placed, own", "gain"]
    summaries = [
        _summary("what is placed, all sets", [one.gains[1] for one in found]),
        _summary("ShapeFit, real sets", [one.gains[0] for one in found if one.name in REAL]),
    ]
    return "\n\n".join([table(header, rows), *summaries])


def _summary(what: str, gains: list[float]) -> str:
    """Return the geometric mean of the gains of some sets against 1, in a sentence."""
    if not gains:
        return f"Gain of {what}: none is there."
    gain = statistics.geometric_mean(gains)
    judged = verdict([Check(name="gain", value=gain, limit=1.0, better="higher")])
    return f"Gain of {what}, geometric mean: {number(gain)}, {judged}."


def comparison_of_real(name: str, folder: Path, truth: str) -> Comparison:
    """Compare on the directions of a COLMAP model, whose matches are read from its database."""
    import numpy as np
    import pycolmap

    from sfm_shapefit.colmap.database import open_database
    from sfm_shapefit.colmap.model import read_model
    from sfm_shapefit.commands.stages.execution import directions_of
    from sfm_shapefit.directions.pair_directions import concatenate
    from sfm_shapefit.options import LocateOptions

    model = read_model(folder / "sparse" / "0")
    wanted = LocateOptions()
    with open_database(folder / "database.db", model) as database:
        parts = [directions_of(b, model.focal_lengths_px, wanted, 1) for b in database.iter_matches(1)]
    known = pycolmap.Reconstruction(folder / truth)
    center_of = {image.name: image.projection_center() for image in known.images.values() if image.has_pose}
    centers = np.array([center_of.get(image, [np.nan] * 3) for image in model.names])
    return compare(name, concatenate(parts), centers)


def comparison_of_made(shape: str, seed: int) -> Comparison:
    """Compare on a made scene of 30 cameras: a tenth of the pairs and a fifth of the matches are wrong."""
    import numpy as np

    from sfm_shapefit.directions.estimate import estimate_directions
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
    angles = np.full(scene.num_pairs, 1.0 / scene.calibration[0, 0])
    directions = estimate_directions(scene.pairs, scene.match_offsets, rays_i, rays_j, angles)
    return compare(f"{shape}, made {seed}", directions, scene.centers)


def compare(name: str, directions: "PairDirections", centers: "FloatArray") -> Comparison:
    """Solve directions with equal weights and with their own; centres (n, 3) are NaN where unknown."""
    own = directions.weights()[directions.usable()]
    return Comparison(
        name=name,
        equal=_errors(directions, own**0, centers),
        weighted=_errors(directions, own, centers),
    )


def _errors(directions: "PairDirections", weights: "FloatArray", centers: "FloatArray") -> Errors:
    """Place the usable directions with weights and compare with the centres."""
    import numpy as np

    from sfm_shapefit import ViewGraph
    from sfm_shapefit.geometry import fit_similarity_l1
    from sfm_shapefit.placement.place import place

    usable = directions.usable()
    graph = ViewGraph(len(centers), directions.pairs[usable], directions.directions[usable], weights)
    placement = place(graph, covariance=directions.covariance[usable])
    true = centers[placement.cameras]
    known = np.isfinite(true).all(axis=1)

    def errors_of(t: "FloatArray") -> tuple[float, float]:
        aligned = fit_similarity_l1(t[known], true[known])
        distances = np.linalg.norm(aligned.apply(t[known]) - true[known], axis=1)
        return float(np.median(distances)), float(np.mean(distances))

    return Errors(shapefit=errors_of(placement.solve.locations), placed=errors_of(placement.locations))
