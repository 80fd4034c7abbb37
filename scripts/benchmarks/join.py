"""Models cut into pieces, and joined by a few of the pairs between these.

Each piece is located from its own images alone, from the rotations of the whole model, adjusted, and moved to
a scale and axes of its own. Of the pairs between every two pieces k are drawn, wrong ones as the database has
them: at castle-P30 half of them, at lego100 up to three quarters. Beside them, wrong pairs are planted:

    random    40 % mistake a camera of the second piece for another one
    shift     40 % agree on the second piece moved by 0.3 of the extent, matches of it cleaner than most

A join is right if the median camera of the piece comes within 5 % of the extent of its place in the world of
the other, exact within 0.1 %. A street that is driven straight bends where its pieces do, by more than that.
A join may be refused; wrong ones must be, or be said to have a rival. Of planted pairs that agree there is no
limit: where fewer than two right pairs are left beside them, nothing says that there is another join.

Two pieces that share three images, which each has located for itself, are joined by two or three of these,
one of them moved and turned in the second piece, alone or with five pairs beside.

Fragments are the models that COLMAP's incremental mapper makes of a database with the k weakest pairs between
two halves of the images. They are joined as a user would, and the reason of a refusal is given.
"""

import argparse
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

import sfm_shapefit
from harness.driver import Benchmark, Case, if_there
from harness.record import Row, at_least, at_most
from harness.scenes import write_scene
from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.base.geometry import Similarity, fit_similarity, invert, normalized
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.reconstructions import transform_model
from sfm_shapefit.pipeline.pieces import ModelPiece, tie_pieces
from sfm_shapefit.placement.join import PieceJoin, join_pieces

SCENES = ("castle-P30", "Herz-Jesus-P25", "lego100", "kitti-turn")
RING = {"shape": "ring", "num_images": 300, "num_points": 6000, "wrong_match_fraction": 0.05, "seed": 1}
PIECES, PAIRS = (2, 3, 5), (3, 5, 10, 20)
PLANTED = {"none": 0.0, "random": 0.4, "shift": 0.4}
RIGHT, EXACT = 0.05, 0.001
"""Errors of the median camera, in extents, up to which a join is right, and exact."""
_SHARED, _BESIDE = 3, 5
"""Images that two pieces share, and pairs beside them."""
_MOVED = 0.3  # extents by which a wrong shared image is off
FRAGMENTED = {"Herz-Jesus-P25": (5, 10), "castle-P30": (5, 10)}
"""Pairs that are left between the halves of a scene."""
_PAIR_BASE = 2147483647  # COLMAP's pair_id is id1 * this + id2
_CLUSTERED = "lego100"
"""Cut by places, since its names have no order; and its truth is better than its model."""


def flags(parser: argparse.ArgumentParser) -> None:
    """Declare where pieces are kept."""
    parser.add_argument(
        "--folder", type=Path, help="where pieces are kept for another run (a temporary folder)"
    )


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return each scene cut into each number of pieces."""
    if args.quick:
        small = RING | {"num_images": 24, "num_points": 600}
        return {"ring 24": partial(measure, "ring 24", small, 2, (10,), args)}
    found: dict[str, Case] = {}
    for count in PIECES:
        for name in SCENES:
            case = partial(measure, name, args.data / name, count, PAIRS, args)
            found[f"{name}, {count}"] = if_there(args.data / name, case)
        found[f"ring 300, {count}"] = partial(measure, "ring 300", RING, count, PAIRS, args)
    for name in ("castle-P30", "Herz-Jesus-P25", "kitti-turn"):
        case = partial(measure_shared, name, args.data / name, args)
        found[f"shared, {name}"] = if_there(args.data / name, case)
    for name, counts in FRAGMENTED.items():
        case = partial(measure_fragments, name, args.data / name, counts)
        found[f"fragments, {name}"] = if_there(args.data / name, case)
    return found


class Cut(NamedTuple):
    """A scene in pieces."""

    pieces: list[Any]
    tied: Any
    truth: list[Any]
    """The similarity of each piece to the whole."""
    centers: dict[str, Any]
    """Of the whole, by name."""

    @property
    def extent(self) -> float:
        """Return how far the cameras of the whole extend."""
        return float(np.linalg.norm(np.ptp(list(self.centers.values()), axis=0)))

    def error(self, join: Any) -> float:
        """Return the distance of the median camera of a piece from its place, in extents."""
        images = self.pieces[join.piece].model.images
        there = self.truth[join.to].apply(join.to_from_piece.apply(images.centers))
        apart = np.linalg.norm(there - [self.centers[name] for name in images.names], axis=1)
        return float(np.median(apart)) / self.extent


def measure(name: str, scene: Any, count: int, pairs: Sequence[int], args: argparse.Namespace) -> list[Row]:
    """Cut a scene, and join its pieces by so many of their pairs, with each kind of planted ones."""
    with tempfile.TemporaryDirectory() as folder:
        if isinstance(scene, dict):
            write_scene(Path(folder) / "scene", scene)
            scene = Path(folder) / "scene"
        model = scene / ("gt" if name == _CLUSTERED else "sparse/0")
        kept = (args.folder or Path(folder)) / f"{name}-{count}"
        whole = cut(model, scene / "database.db", kept, count, by_place=name == _CLUSTERED)
    return [
        judge(name, count, k, kind, list(trials(whole, k, kind, args.repeats)))
        for kind in PLANTED
        for k in pairs
    ]


def cut(
    model: Path, database: Path, kept: Path, count: int, *, by_place: bool = False, overlap: int = 0
) -> Cut:
    """Locate the images of each piece alone, if they are not kept, and move each to a world of its own.

    A piece has the first images of the next one too, if they are to overlap.
    """
    images, rng = read_model(model).images, np.random.default_rng(count)
    labels = np.arange(images.num_images) * count // images.num_images
    if by_place:
        labels = kmeans2(images.centers, count, seed=1, minit="++")[1]
    pieces = []
    for label in range(count):
        if not (kept / str(label)).exists():
            part = pycolmap.Reconstruction(model)
            own = labels == label
            own[np.flatnonzero(labels == label + 1)[:overlap]] = True
            for image_id in images.ids[~own].tolist():
                part.deregister_frame(part.image(image_id).frame_id)
            found = sfm_shapefit.locate(part, database, adjust="full", min_trust=0.0)
            sfm_shapefit.write_result(found, kept / str(label), report=False)
        found = pycolmap.Reconstruction(kept / str(label))
        world = Similarity(
            scale=float(np.exp(0.7 * rng.standard_normal())),
            rotation=Rotation.random(random_state=rng).as_matrix(),
            translation=5.0 * rng.standard_normal(3),
        )
        pieces.append(ModelPiece(label=str(label), model=read_model(transform_model(found, world))))
    matches = open_database(database, images.names)
    tied = tie_pieces(pieces, matches, frozenset())
    matches.close()
    centers = dict(zip(images.names, images.centers, strict=True))
    truth = [
        fit_similarity(own.centers, np.array([centers[name] for name in own.names]))
        for own in (piece.model.images for piece in pieces)
    ]
    return Cut(pieces, tied, truth, centers)


def measure_shared(name: str, scene: Path, args: argparse.Namespace) -> list[Row]:
    """Cut a scene into two pieces that share images, and join it by some of these, one of them wrong."""
    with tempfile.TemporaryDirectory() as folder:
        kept = (args.folder or Path(folder)) / f"{name}-shared"
        whole = cut(scene / "sparse/0", scene / "database.db", kept, 2, overlap=_SHARED)
    return [
        shared_row(name, count, wrong, beside, list(shared_trials(whole, count, wrong, beside, args.repeats)))
        for count, wrong in ((2, 0), (3, 0), (3, 1))
        for beside in (0, _BESIDE)
    ]


def shared_trials(whole: Cut, count: int, wrong: int, beside: int, seeds: int) -> "Iterator[Outcome]":
    """Yield what comes of the second piece, in draws of shared images, of those wrong, and of pairs."""
    ties, size = whole.tied.ties, whole.extent / whole.truth[1].scale
    for seed in range(seeds):
        rng, cameras = np.random.default_rng([seed, count, wrong]), whole.tied.cameras
        shared = rng.permutation(np.flatnonzero(ties.is_shared))[:count]
        pairs = rng.permutation(np.flatnonzero(~ties.is_shared))[:beside]
        centers, rotations = cameras.centers.copy(), cameras.rotations.copy()
        for camera in ties.matches.pairs[shared[:wrong], 1].tolist():
            centers[camera] += _MOVED * size * normalized(rng.standard_normal((1, 3)))[0]
            rotations[camera] = Rotation.random(random_state=rng).as_matrix() @ rotations[camera]
        drawn = ties.subset(np.sort(np.concatenate([shared, pairs])))
        yield from outcomes(whole, replace(cameras, centers=centers, rotations=rotations), drawn)


def shared_row(name: str, count: int, wrong: int, beside: int, found: "Sequence[Outcome]") -> Row:
    """Return the row of two pieces with so many images in common, and so many pairs beside."""
    cells = {"scene": name, "shared": count, "of them wrong": wrong, "pairs beside": beside}
    told, unsaid = summed(found)
    return Row(cells | told, at_most(wrong=(unsaid, 0)), table="Two pieces that share images")


def measure_fragments(name: str, scene: Path, counts: Sequence[int]) -> list[Row]:
    """Let COLMAP map a scene of which few pairs between its halves are left, and join what it leaves."""
    rows = []
    for k in counts:
        with tempfile.TemporaryDirectory() as work:
            folder = Path(work)
            database = folder / "database.db"
            shutil.copyfile(scene / "database.db", database)
            keep_pairs(database, k)
            (folder / "images").mkdir()
            (folder / "out").mkdir()
            options = pycolmap.IncrementalPipelineOptions()
            options.num_threads, options.random_seed, options.min_model_size = 2, 0, 3
            copied = shutil.copyfile(database, folder / "copy.db")
            found = pycolmap.incremental_mapping(copied, folder / "images", folder / "out", options)
            models = sorted(found.values(), key=lambda model: -model.num_reg_images())
            rows.append(fragments_row(name, k, models, database, pycolmap.Reconstruction(scene / "gt")))
    return rows


def keep_pairs(database: Path, count: int) -> None:
    """Leave the weakest pairs between the first half of the images and the second, by their names.

    By strong ones the mapper registers the second half beside the first, and leaves no fragments.
    """
    with sqlite3.connect(database) as opened:
        ids = [i for (i,) in opened.execute("SELECT image_id FROM images ORDER BY name")]
        half = {i: 2 * place // len(ids) for place, i in enumerate(ids)}
        query = "SELECT pair_id FROM two_view_geometries WHERE rows >= 15 ORDER BY rows, pair_id"
        across = [p for (p,) in opened.execute(query) if half[p // _PAIR_BASE] != half[p % _PAIR_BASE]]
        kept = set(across[:count])
        every = [p for (p,) in opened.execute("SELECT pair_id FROM two_view_geometries")]
        for table in ("two_view_geometries", "matches"):
            opened.executemany(
                f"DELETE FROM {table} WHERE pair_id = ?",
                [(p,) for p in every if half[p // _PAIR_BASE] != half[p % _PAIR_BASE] and p not in kept],
            )
    opened.close()


def fragments_row(name: str, k: int, models: Sequence[Any], database: Path, truth: Any) -> Row:
    """Return the row of the models that a mapper left, joined where that is safe."""
    cells = {"scene": name, "k": k, "models of COLMAP": [model.num_reg_images() for model in models]}
    joined, error, told, seconds = "-", np.nan, "one model: nothing to join", np.nan
    if len(models) > 1:
        start = time.process_time()
        try:
            found = sfm_shapefit.join(models, database)
            error = sfm_shapefit.evaluate(found.reconstruction, truth).position.median
            extent = np.ptp([i.projection_center() for i in truth.images.values() if i.has_pose], axis=0)
            error /= float(np.linalg.norm(extent))
            joined, told = f"{found.reconstruction.num_reg_images()} images", found.joins[0].statement
        except ShapeFitError as refused:
            joined, told = "refused", str(refused)
        seconds = time.process_time() - start
    wrong = int(error > RIGHT)
    cells |= {"joined": joined, "error %": 100.0 * error, "CPU s": seconds, "told": told}
    return Row(cells, at_most(wrong=(wrong, 0)), table="Fragments that COLMAP's mapper leaves")


class Outcome(NamedTuple):
    """What came of one piece."""

    error: float
    """In extents; NaN where there was no join to judge."""
    accepted: bool
    has_rival: bool
    seconds: float


def trials(whole: Cut, count: int, kind: str, seeds: int) -> Iterator[Outcome]:
    """Yield what comes of each piece, in draws of the pairs between them."""
    cameras, ties = whole.tied.cameras, whole.tied.ties
    pieces = cameras.piece_of[ties.matches.pairs]
    for seed in range(seeds):
        rng, chosen = np.random.default_rng([seed, count, len(kind)]), []
        for two in np.unique(pieces, axis=0):
            rows = np.flatnonzero((pieces == two).all(axis=1))
            chosen.append(rng.permutation(rows)[:count])
        drawn = ties.subset(np.sort(np.concatenate(chosen)))
        yield from outcomes(whole, cameras, plant(whole, drawn, kind, rng))


def outcomes(whole: Cut, cameras: Any, ties: Any) -> Iterator[Outcome]:
    """Yield what comes of each piece."""
    start = time.process_time()
    joins = join_pieces(cameras, ties)
    seconds = time.process_time() - start
    for join in joins.values():
        if isinstance(join, PieceJoin):
            yield Outcome(whole.error(join), not join.reason, len(join.rivals) > 0, seconds)
        else:
            yield Outcome(np.nan, False, False, seconds)


def plant(whole: Cut, ties: Any, kind: str, rng: np.random.Generator) -> Any:
    """Return the ties with a share of their pairs made wrong."""
    cameras, points = whole.tied.cameras, ties.points.copy()
    pairs, rays = ties.matches.pairs.copy(), [ties.matches.rays_i.copy(), ties.matches.rays_j.copy()]
    pieces = cameras.piece_of[pairs]
    shifts: dict[int, Any] = {}
    for two in np.unique(pieces, axis=0).tolist():
        own = np.flatnonzero((pieces == two).all(axis=1))
        for pair in rng.permutation(own)[: round(PLANTED[kind] * len(own))].tolist():
            rows = slice(*ties.matches.offsets[pair : pair + 2].tolist())
            i, j = pairs[pair].tolist()
            if kind == "random":  # another camera of the second piece is taken for this one
                other = int(rng.choice(np.flatnonzero(cameras.piece_of == two[1])))
                seen = (points[rows, 1] - cameras.centers[j]) @ cameras.rotations[j].T
                points[rows, 1] = seen @ cameras.rotations[other] + cameras.centers[other]
                pairs[pair, 1] = other
                continue
            step = shifts.setdefault(two[1], 0.3 * whole.extent * normalized(rng.standard_normal((1, 3)))[0])
            known = np.flatnonzero(np.isfinite(points[rows, 1]).all(axis=1))
            if not len(known):
                continue
            some = points[rows, 1][rng.choice(known, rows.stop - rows.start)]
            false = invert(whole.truth[two[0]]).apply(whole.truth[two[1]].apply(some) + step)
            noise = ties.matches.pixel_angles[pair] * rng.standard_normal((2, len(some), 3))
            for way, (v, at) in enumerate(((i, false), (j, some))):
                looks = normalized(at - cameras.centers[v]) @ cameras.rotations[v].T
                rays[way][rows] = normalized(looks + noise[way])
            points[rows, 0], points[rows, 1] = np.where(rng.random((len(some), 1)) < 0.5, false, np.nan), some
    matches = replace(ties.matches, pairs=pairs, rays_i=rays[0], rays_j=rays[1])
    return replace(ties, matches=matches, points=points)


def judge(name: str, count: int, k: int, kind: str, found: Sequence[Outcome]) -> Row:
    """Return the row of a cut with so many pairs: nothing wrong is accepted without a word."""
    told, unsaid = summed(found)
    share = sum(one.accepted and one.error <= RIGHT for one in found) / len(found)
    goal = 0.95 if k >= 10 and kind == "none" else None
    most = None if kind == "shift" else 0  # where more planted pairs are left than right ones, none can know
    cells = {"scene": name, "pieces": count, "k": k, "planted": kind}
    return Row(cells | told, at_most(wrong=(unsaid, most)) + at_least(right=(share, goal)))


def summed(found: Sequence[Outcome]) -> tuple[dict[str, Any], int]:
    """Return the cells of what came of pieces, and how many wrong joins were accepted without a word."""
    right = [one for one in found if one.accepted and one.error <= RIGHT]
    wrong = [one for one in found if one.accepted and one.error > RIGHT]
    refused = [one for one in found if not one.accepted]
    unsaid = sum(not one.has_rival for one in wrong)
    cells = {
        "right": f"{len(right)} of {len(found)}",
        "exact": sum(one.error <= EXACT for one in right),
        "refused, found right": sum(one.error <= RIGHT for one in refused),
        "refused, else": sum(not one.error <= RIGHT for one in refused),
        "wrong": len(wrong),
        "unsaid": unsaid,
        "error %": 100.0 * float(np.median([one.error for one in right])) if right else np.nan,
        "CPU s": float(np.median([one.seconds for one in found])),
    }
    return cells, unsaid


BENCHMARK = Benchmark(
    name="join",
    title="Pieces joined",
    cases=cases,
    flags=flags,
    quick={"repeats": 1},
    repeats=5,
    columns={
        "k": "pairs; between every two pieces",
        "right": f"pieces; accepted, and within {RIGHT:.0%} of the extent",
        "exact": f"pieces; of these, within {EXACT:.1%}",
        "refused, found right": "pieces; refused, most for too few agreeing pairs, though in their place",
        "refused, else": "pieces; refused, and no place was found, or a wrong one",
        "wrong": "pieces; accepted, and farther off",
        "unsaid": "pieces; of these, those without a word of a rival, which the limit counts",
        "shared": "images that both pieces have",
        "of them wrong": f"images of these that stand elsewhere in the second piece, by {_MOVED} extents",
        "pairs beside": "pairs between the two, drawn from all",
        "told": "what is said of the join, or why it is refused",
        "error %": "of the extent; median of the right ones",
        "CPU s": "seconds; of all pieces together, matches read",
    },
)
