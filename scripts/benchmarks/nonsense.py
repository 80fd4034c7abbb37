"""Databases of what belongs to no one model: two scenes mixed, one picture many times, noise, moving dots.

Whatever `map` makes of them, no model is to be called good that joins what does not belong: by `map` itself,
by `check`, beside the same database, and by `locate`. Pairs are verified as COLMAP does it. Two scenes are
mixed with false pairs between them, which agree each on a pose of their own; a model of one of them alone is
right. One picture is repeated with some noise; keypoints at random match at random, as far as an
epipolar geometry drawn for each pair has it; dots move each on a way of its own, before a camera that stands
still, moves, or turns.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

import sfm_shapefit
from harness.driver import Benchmark, Case
from harness.record import Row, at_most, table
from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.judgement.grade import Grade
from sfm_shapefit.synthetic import SceneOptions, make_scene

SIZE_PX, FOCAL_PX = (1200, 900), 1000.0
CALIBRATION = np.array([[FOCAL_PX, 0.0, 600.0], [0.0, FOCAL_PX, 450.0], [0.0, 0.0, 1.0]])


class Made(NamedTuple):
    """Keypoints and matches before verification."""

    keypoints: list[np.ndarray]
    """Per image (k, 2)."""
    matches: dict[tuple[int, int], np.ndarray]
    """(m, 2) of each pair of images."""
    scene_of: np.ndarray
    """(n,) which scene an image shows; a model of images of one scene is right, of -1 none is."""


def two_scenes(shapes: tuple[str, str], num_across: int, seed: int, num_images: int = 12) -> Made:
    """Return two scenes with false pairs between them."""
    rng = np.random.default_rng([seed, num_across])
    keypoints, matches = list[np.ndarray](), dict[tuple[int, int], np.ndarray]()
    for k, shape in enumerate(shapes):
        scene = make_scene(
            SceneOptions(shape=shape, num_images=num_images, num_points=1200, seed=2 * seed + k)
        )
        first = len(keypoints)
        keypoints += [xy.copy() for xy in scene.keypoints]
        for e, (i, j) in enumerate(scene.pairs.tolist()):
            matches[first + i, first + j] = scene.matches_of(e)
    half = len(keypoints) // 2
    across = rng.permutation(half * half)[:num_across]
    for i, j in zip((across // half).tolist(), (half + across % half).tolist(), strict=True):
        count = min(60, len(keypoints[i]))
        own = np.sort(rng.permutation(len(keypoints[i]))[:count])
        begin = len(keypoints[j])
        keypoints[j] = np.concatenate([keypoints[j], transferred(keypoints[i][own], rng)])
        matches[i, j] = np.column_stack([own, begin + np.arange(count)])
    return Made(keypoints, matches, np.repeat([0, 1], half))


def transferred(xy: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return keypoints (k, 2) as another camera, drawn at random, sees them at random depths."""
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(CALIBRATION).T
    points = rays * rng.uniform(4.0, 12.0, len(xy))[:, None]
    turn = Rotation.from_rotvec(0.2 * rng.standard_normal(3)).as_matrix()
    shift = rng.standard_normal(3)
    seen = (points @ turn.T + shift / np.linalg.norm(shift)) @ CALIBRATION.T
    return seen[:, :2] / seen[:, 2:] + 0.5 * rng.standard_normal(xy.shape)


def one_picture(num_copies: int, noise_px: float, seed: int) -> Made:
    """Return one picture many times."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((0.0, 0.0), SIZE_PX, (500, 2))
    keypoints = [xy + noise_px * rng.standard_normal(xy.shape) for _ in range(num_copies)]
    return Made(keypoints, everything(num_copies, 500), np.full(num_copies, -1))


def everything(num_images: int, count: int) -> dict[tuple[int, int], np.ndarray]:
    """Return matches of equal keypoints between all pairs."""
    same = np.tile(np.arange(count)[:, None], (1, 2))
    return {(i, j): same for j in range(num_images) for i in range(j)}


def noise(num_images: int, count: int, share: float, seed: int) -> Made:
    """Return random keypoints, and a share of pairs with matches that a random pose of each explains."""
    rng = np.random.default_rng(seed)
    keypoints = [rng.uniform((0.0, 0.0), SIZE_PX, (400, 2)) for _ in range(num_images)]
    matches = dict[tuple[int, int], np.ndarray]()
    for pair in everything(num_images, 1):
        if rng.random() < share:
            i, j = pair
            own, begin = rng.permutation(len(keypoints[i]))[:count], len(keypoints[j])
            keypoints[j] = np.concatenate([keypoints[j], transferred(keypoints[i][own], rng)])
            matches[pair] = np.column_stack([own, begin + np.arange(count)])
    return Made(keypoints, matches, np.full(num_images, -1))


def moving_dots(num_images: int, camera: str, motion: str, seed: int) -> Made:
    """Return dots that move each its own way, or as waves do, before a camera that stands, moves or turns."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-4.0, -3.0, 6.0), (4.0, 3.0, 12.0), (400, 3))
    way, phase = 0.15 * rng.standard_normal((400, 3)), rng.uniform(0.0, 2.0 * np.pi, 400)
    keypoints = []
    for k in range(num_images):
        offset = way * k if motion == "straight" else 3.0 * way * np.sin(0.7 * k + phase)[:, None]
        angle = 0.05 * k if camera == "turns" else 0.0
        center = np.array([0.25 * k, 0.0, 0.0]) if camera == "moves" else np.zeros(3)
        turn = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        seen = (points + offset - center) @ turn.T @ CALIBRATION.T
        keypoints.append(seen[:, :2] / seen[:, 2:] + 0.5 * rng.standard_normal((400, 2)))
    return Made(keypoints, everything(num_images, 400), np.full(num_images, -1))


def write(made: Made, path: Path, *, is_calibrated: bool) -> None:
    """Write a database of what was made, verified as COLMAP does it."""
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=SIZE_PX[0], height=SIZE_PX[1], params=[FOCAL_PX, 600, 450], camera_id=1
    )
    camera.has_prior_focal_length = is_calibrated
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with quiet_log(), pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        for k, xy in enumerate(made.keypoints):
            image = pycolmap.Image(name=f"{k:04d}.jpg", camera_id=1, image_id=k + 1)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(k + 1, xy.astype(np.float32))
        for (i, j), matches in sorted(made.matches.items()):
            ends = camera, made.keypoints[i], camera, made.keypoints[j]
            rows = matches.astype(np.uint32)
            geometry = pycolmap.estimate_two_view_geometry(*ends, rows, options)
            database.write_matches(i + 1, j + 1, rows)
            if len(geometry.inlier_matches) >= options.min_num_inliers:
                database.write_two_view_geometry(i + 1, j + 1, geometry)


def makers() -> Iterator[tuple[str, str, Callable[[], Made]]]:
    """Yield the family, the name and the maker of each database."""
    for shapes in (("ring", "facade"), ("courtyard", "drive")):
        for num in (0, 1, 2, 3, 5, 8, 15, 30):
            for seed in (0, 1):
                yield (
                    "mixed",
                    f"{'+'.join(shapes)}, {num} across, {seed}",
                    partial(two_scenes, shapes, num, seed),
                )
    for noise_px in (0.0, 0.3, 1.0, 2.0):
        for num in (3, 8, 14):
            yield "repeated", f"{num} times, {noise_px} px", partial(one_picture, num, noise_px, num)
    for share in (0.3, 0.7, 1.0):
        for count in (20, 60):
            for num in (6, 16):
                name = f"{num} images, {share:.0%} of pairs, {count} matches"
                yield "noise", name, partial(noise, num, count, share, num)
    for camera in ("stands", "moves", "turns"):
        for motion in ("straight", "waves"):
            for num in (5, 12):
                yield "dots", f"{camera}, {motion}, {num}", partial(moving_dots, num, camera, motion, num)


def judge(family: str, name: str, make: Callable[[], Made]) -> list[Row]:
    """Return a row of a database, calibrated and not."""
    rows = []
    for is_calibrated in (True, False):
        with TemporaryDirectory() as folder:
            made, path = make(), Path(folder) / "database.db"
            write(made, path, is_calibrated=is_calibrated)
            verdicts = [*judge_mapped(path, made.scene_of), *judge_colmap(path, made.scene_of)]
        false = [f"{who} {grade}" for who, grade in verdicts if who and grade == Grade.GOOD]
        cells = {
            "family": family,
            "database": f"{name}, {'calibrated' if is_calibrated else 'guessed'}",
            "models": len(verdicts),
            "false ones": ", ".join(f"{who} {grade}" for who, grade in verdicts if who),
            "called good": len(false),
        }
        rows.append(Row(cells, at_most(**{"called good": (len(false), 0)})))
    return rows


def judge_mapped(path: Path, scene_of: np.ndarray) -> Iterator[tuple[str, str]]:
    """Yield who judged a false model, else "", and how, of the models of `map`, by three commands."""
    try:
        found = sfm_shapefit.map_database(path)
    except ShapeFitError:
        return
    for model in found.models:
        is_false = joins(model.reconstruction, scene_of)
        yield "map" * is_false, model.verdict.grade.value
        verdict = sfm_shapefit.check(model.reconstruction, path, second_opinion=found).verdict
        yield "check" * is_false, verdict.grade.value
        try:
            yield (
                "locate" * is_false,
                sfm_shapefit.locate(model.reconstruction, path).verdict.grade.value,
            )
        except ShapeFitError:
            yield "locate" * is_false, "refused"


def judge_colmap(path: Path, scene_of: np.ndarray) -> Iterator[tuple[str, str]]:
    """Yield the same of the models of COLMAP."""
    with quiet_log(), TemporaryDirectory() as out:
        options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1)
        models = pycolmap.incremental_mapping(path, out, out, options)
    for model in models.values():
        who = "COLMAP's by check" * joins(model, scene_of)
        yield who, sfm_shapefit.check(model, path).verdict.grade.value


def joins(model: pycolmap.Reconstruction, scene_of: np.ndarray) -> bool:
    """Return whether a model has images that do not belong together."""
    scenes = {int(scene_of[int(model.image(k).name[:4])]) for k in model.reg_image_ids()}
    return len(scenes) > 1 or -1 in scenes


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return a case per database; the quick version has one of each family."""
    chosen, seen = dict[str, Case](), set[str]()
    for family, name, make in makers():
        if not (args.quick and family in seen):
            chosen[f"{family}: {name}"] = partial(judge, family, name, make)
        seen.add(family)
    return chosen


def summarize(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the counts by family."""
    lines = []
    for family in dict.fromkeys(row["family"] for row in rows):
        own = [row for row in rows if row["family"] == family]
        lines.append(
            [family, len(own), sum(row["models"] for row in own), sum(row["called good"] for row in own)]
        )
    yield "## Over all databases"
    yield table(["family", "databases", "verdicts", "false models called good"], lines)


BENCHMARK = Benchmark(
    name="nonsense",
    title="Databases of nonsense",
    cases=cases,
    closing=summarize,
    columns={
        "database": "what was made, with a lens that counts as calibrated, or as guessed",
        "models": "verdicts on the models of `map`, by it, `check` and `locate`, and of COLMAP, by `check`",
        "false ones": "who judged a model that joins what does not belong, and how",
        "called good": "verdicts of these that are good",
    },
)
