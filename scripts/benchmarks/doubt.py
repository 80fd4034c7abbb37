"""Doubt: are cameras with wrong rotations or focal lengths found, and right ones kept?

Cameras of scenes are turned by 2, 5, 20 and 180 degrees about random axes: one by one, and where a scene
has 15 cameras or more, in groups of five that agree among themselves (a camera and those it shares most
inlier matches with, all turned alike). A turned camera counts as kept if `locate` without its adjustment
places it with a trust above 0.6, and if `locate` in full, which is run where there is such a camera, delivers
it with a rotation that is off by more than half of the turn: the adjustment may have put it right. Each scene
is also run as it is; there a camera is right if its rotation is within 5 degrees of the truth, after the best
common rotation, and a right camera is blamed if it was placed and is left out for want of trust.

Focal lengths: a third of the images of a scene, or those of one of its cameras, get a camera of their own
whose focal length is off by 10, 30 or 140 %. It is named if it is the first that is doubted; any other that
is named is named falsely. Each scene is asked without an error, too.

The scenes at hand were used for choosing the constants of `judgement.turns`; the drawn ones, of whose houses
half look the same, were not. Those of `judgement.focal_lengths` were chosen on fountain-P11, Herz-Jesus-P8,
castle-P19, lego100, brighton-beach, robots-1 and photographed; Herz-Jesus-P25, castle-P30, kerry-park and
courtyard chose nothing there.
"""

import argparse
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from benchmarks.trust import rotation_errors_deg
from harness import ours
from harness.driver import ROOT, Benchmark, Case, if_there
from harness.metrics import Check, Quantity, number, verdict
from harness.record import table_of

if TYPE_CHECKING:
    from sfm_shapefit.base.arrays import FloatArray, IntArray
    from sfm_shapefit.files.colmap.model import PosedModel
    from sfm_shapefit.pairs.pair_directions import PairDirections
    from sfm_shapefit.placement.place import Placement

SETS = {
    "fountain-P11": ("sparse/0", "gt"),
    "Herz-Jesus-P8": ("sparse/0", "gt"),
    "Herz-Jesus-P25": ("sparse/0", "gt"),
    "castle-P19": ("sparse/0", "gt"),
    "castle-P30": ("sparse/0", "gt"),
    "lego100": ("sparse/0", "gt"),
    "lego100 (gt)": ("gt", "gt"),
    "kitti-turn": ("sparse/0", "sparse/0"),
    "brighton-beach": ("sparse/0", "sparse/0"),
    "robots-1": ("sparse/0", "sparse/0"),
    "kerry-park": ("sparse/0", "global"),
    "kerry-park (global)": ("global", "global"),
}
"""The model that gives rotations, and the truth."""
BUNDLED = ("courtyard", "photographed")
DRAWN = {"drawn ring": ("ring", 1), "drawn facade": ("facade", 2), "drawn courtyard": ("courtyard", 3)}
"""Shape and seed; half of the houses look the same."""
ANGLES_DEG = (2.0, 5.0, 20.0, 180.0)
FACTORS = (1.1, 0.9, 1.3, 0.7, 2.4, 1.0 / 2.4)
TRUSTED = 0.6
WRONG_DEG = 5.0
GROUP = 5
LARGE_ENOUGH = 15


class Turned(NamedTuple):
    """How the cameras of one scene fared."""

    name: str
    num_cameras: int
    num_blamed: int
    """Right cameras left out for want of trust, in the scene as it is."""
    num_registered: int
    """Images of the frames of kept cameras, in the scene as it is."""
    num_wrong: int
    """Wrong cameras in the scene as it is."""
    num_wrong_kept: int
    turned: tuple[int, ...]
    """By angle, how many cameras were turned in all runs."""
    kept: tuple[int, ...]
    """By angle, how many of them were kept."""
    others_blamed: float
    """Share of the right cameras left out while others were turned."""


class Focal(NamedTuple):
    """How often wrong focal lengths were named."""

    name: str
    num_asked: int
    num_named: int
    num_false: int
    """Cameras named falsely, in the runs with and without an error."""


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return the scenes, each once for rotations and once for focal lengths."""
    folders = {name: (args.data / name.split(" ")[0], *models) for name, models in SETS.items()}
    folders |= {name: (ROOT / "data_synthetic" / name, "sparse/0", "truth") for name in BUNDLED}
    if args.quick:
        folders = {"ring8": (ROOT / "data_synthetic" / "ring8", "sparse/0", "sparse/0")}
    found: dict[str, Case] = {}
    for name, (folder, given, truth) in folders.items():
        scene = Scene(name, folder / given, folder / "database.db", folder / truth)
        found[name] = if_there(folder, partial(turn_cameras, scene, args.repeats))
        if name not in {"kitti-turn", "kerry-park (global)", "lego100 (gt)"}:
            found[f"{name}, focal length"] = if_there(folder, partial(change_focal_lengths, scene))
    if not args.quick:
        for name in DRAWN:
            found[name] = partial(draw, name, args.repeats)
    return found


class Scene(NamedTuple):
    """Where a scene lies."""

    name: str
    model: Path
    database: Path
    truth: Path


def draw(name: str, repeats: int) -> Turned:
    """Draw a scene whose houses look alike, and turn its cameras."""
    from sfm_shapefit.synthetic import RenderOptions, SceneOptions, WorkspaceOptions, make_rendered_scene
    from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace

    shape, seed = DRAWN[name]
    size = {"num_images": 20, "image_width": 800, "image_height": 600}
    options = SceneOptions(shape=shape, seed=seed, **size)  # type: ignore[arg-type]
    scene = make_rendered_scene(options, RenderOptions(repeated_fraction=0.5))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "scene"
        write_rendered_workspace(scene, root, WorkspaceOptions(model="rotations"))
        return turn_cameras(Scene(name, root / "sparse" / "0", root / "database.db", root / "truth"), repeats)


def turn_cameras(scene: Scene, repeats: int) -> Turned:
    """Run a scene as it is, and with turned cameras."""
    from sfm_shapefit.files.colmap.model import read_model

    model = read_model(scene.model)
    wrong = rotation_errors_deg(model, read_model(scene.truth)) > WRONG_DEG
    directions, placement = judge(model, scene)
    blamed, wrong_kept = left_out(placement) & ~wrong, trusted(placement) & wrong
    frames = model.frame_ids[trusted(placement)]
    rng = np.random.default_rng(zlib.crc32(scene.name.encode()))
    chosen = rng.permutation(model.num_images)[:repeats].tolist()
    groups: list[IntArray] = [np.array([camera]) for camera in chosen]
    if model.num_images >= LARGE_ENOUGH:
        groups += [neighbors(directions, camera, model.num_images) for camera in chosen[:2]]
    turned, kept = np.zeros(len(ANGLES_DEG), dtype=int), np.zeros(len(ANGLES_DEG), dtype=int)
    others, lost = 0, 0
    for k, angle_deg in enumerate(ANGLES_DEG):
        for group in groups:
            changed, cameras = turn(model, group, rng.standard_normal(3), angle_deg)
            _, found = judge(changed, scene)
            turned[k] += len(cameras)
            believed = cameras[trusted(found)[cameras]]
            if len(believed):
                kept[k] += num_still_off(scene, changed, believed, 0.5 * angle_deg)
            right = ~wrong
            right[cameras] = False
            others += int(right.sum())
            lost += int((left_out(found) & right).sum())
    return Turned(
        name=scene.name,
        num_cameras=model.num_images,
        num_blamed=int(blamed.sum()),
        num_registered=int(np.isin(model.frame_ids, frames).sum()),
        num_wrong=int(wrong.sum()),
        num_wrong_kept=int(wrong_kept.sum()),
        turned=tuple(turned.tolist()),
        kept=tuple(kept.tolist()),
        others_blamed=lost / others,
    )


def judge(model: "PosedModel", scene: Scene) -> "tuple[PairDirections, Placement]":
    """Place the cameras of a model and judge them: `locate` without points."""
    from sfm_shapefit import LocateOptions
    from sfm_shapefit.pipeline.clock import Clock
    from sfm_shapefit.pipeline.doubts import ask_pairs, doubt_cameras
    from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
    from sfm_shapefit.pipeline.measure import Wanted, add_evidence, build_graph, measure, wants_points
    from sfm_shapefit.pipeline.rigs import find_rigid_parts, place_cameras

    options, clock = LocateOptions(threads=2), Clock()
    rigid = find_rigid_parts(model, options, has_priors=False)
    with open_source(model, choose_inputs(scene.model, scene.database, "auto"), options) as source:
        found = measure(source, options, clock, Wanted(tracks=wants_points(source, options), errors=True))
        directions = found.directions
        measured = add_evidence(rigid.apply(build_graph(source.model, found)), found)
        placement = place_cameras(measured, options, clock)
        relative = ask_pairs(source, directions, options)
    return directions, doubt_cameras(placement, directions, relative, model)


def num_still_off(scene: Scene, changed: "PosedModel", cameras: "IntArray", least_deg: float) -> int:
    """Return how many of some turned cameras `locate` delivers with a rotation off by an angle or more.

    Args:
        scene: as it is.
        changed: its model, with frames that are turned.
        cameras: indices of images.
        least_deg: the angle.
    """
    import pycolmap

    from sfm_shapefit.files.colmap.model import read_model

    given, model = pycolmap.Reconstruction(scene.model), read_model(scene.model)
    turns = model.rotations.transpose(0, 2, 1) @ changed.rotations
    for frame_id, first in zip(*np.unique(model.frame_ids, return_index=True), strict=True):
        pose = given.frame(int(frame_id)).rig_from_world
        rotation = pose.rotation * pycolmap.Rotation3d(turns[first])
        center = pose.inverse().translation
        given.frame(int(frame_id)).rig_from_world = pycolmap.Rigid3d(rotation, -(rotation * center))
    delivered = read_model(ours.locate(given, scene.database, threads=2).reconstruction)
    errors = dict(zip(delivered.names, rotation_errors_deg(delivered, read_model(scene.truth)), strict=True))
    found = [errors[model.names[camera]] for camera in cameras.tolist() if model.names[camera] in errors]
    return sum(not error < least_deg for error in found)


def trusted(placement: "Placement") -> Any:
    """Return which of all images are placed with enough trust."""
    found = np.zeros(placement.num_cameras, dtype=bool)
    found[placement.cameras] = placement.assessment.trust > TRUSTED
    return found


def left_out(placement: "Placement") -> Any:
    """Return which of all images are placed without enough trust."""
    found = np.zeros(placement.num_cameras, dtype=bool)
    found[placement.cameras] = placement.assessment.trust < TRUSTED
    return found


def neighbors(directions: "PairDirections", camera: int, num_images: int) -> "IntArray":
    """Return a camera and four more, one after the other that of most inlier matches with those before."""
    counts = np.zeros((num_images, num_images))
    usable = directions.usable()
    i, j = directions.pairs[usable].T
    counts[i, j] = counts[j, i] = directions.num_inliers[usable]
    group = [camera]
    while len(group) < GROUP:
        shared = counts[group].sum(axis=0)
        shared[group] = -1.0
        group.append(int(np.argmax(shared)))
    return np.array(group)


def turn(
    model: "PosedModel", cameras: "IntArray", axis: "FloatArray", angle_deg: float
) -> "tuple[PosedModel, IntArray]":
    """Return a model whose cameras, with all of their frames, are turned alike, and which these are."""
    from scipy.spatial.transform import Rotation

    matrix = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
    cameras = np.flatnonzero(np.isin(model.frame_ids, model.frame_ids[cameras]))
    rotations, offsets = np.array(model.rotations), np.array(model.frame_offsets)
    rotations[cameras] = rotations[cameras] @ matrix.T
    offsets[cameras] = offsets[cameras] @ matrix.T
    rotations.flags.writeable = offsets.flags.writeable = False
    return replace(model, rotations=rotations, frame_offsets=offsets), cameras


def change_focal_lengths(scene: Scene) -> Focal:
    """Ask for focal lengths, where one camera has a wrong one and where none has."""
    from sfm_shapefit.files.colmap.model import read_model

    model = read_model(scene.model)
    if model.has_rigs:
        # Without its rig the model is one of several cameras all the same.
        model = replace(model, frame_ids=np.arange(model.num_images))
    ids = np.array([model.camera(k).camera_id for k in range(model.num_images)])
    images = [np.flatnonzero(ids == i) for i in np.unique(ids)]
    if len(images) == 1:
        images = [np.arange(model.num_images)[::3], np.arange(model.num_images // 3)]
    asked, named, false = 0, 0, 0
    for chosen in images:
        for factor in (1.0, *FACTORS):
            changed, camera = change_camera(model, chosen, factor)
            found = ask(changed, scene)
            right = factor != 1.0 and [doubt.camera for doubt in found[:1]] == [camera]
            asked += factor != 1.0
            named += right
            false += len(found) - right
    return Focal(scene.name, asked, named, false)


def change_camera(model: "PosedModel", images: "IntArray", factor: float) -> "tuple[PosedModel, int]":
    """Return a model some of whose images have a camera of their own, of another focal length, and its id."""
    from sfm_shapefit.files.colmap.model import from_posed_cameras, posed_cameras

    scene = posed_cameras(model)
    first = scene.cameras[int(scene.camera_of[images[0]])]
    model_name, params = first.model, list(first.params)
    for k in range(1 if model_name.startswith(("SIMPLE", "RADIAL")) else 2):
        params[k] *= factor
    camera_of = scene.camera_of.copy()
    camera_of[images] = len(scene.cameras)
    used, camera_of = np.unique(camera_of, return_inverse=True)
    cameras = (*scene.cameras, first._replace(params=tuple(params)))
    changed = replace(scene, cameras=tuple(cameras[k] for k in used), camera_of=camera_of)
    return from_posed_cameras(changed), len(used)


def ask(model: "PosedModel", scene: Scene) -> Any:
    """Return the cameras whose matches prefer another focal length."""
    from sfm_shapefit import LocateOptions
    from sfm_shapefit.pipeline.clock import Clock
    from sfm_shapefit.pipeline.doubts import question_focal_lengths
    from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
    from sfm_shapefit.pipeline.measure import measure

    options = LocateOptions(threads=2)
    with open_source(model, choose_inputs(scene.model, scene.database, "auto"), options) as source:
        directions = measure(source, options, Clock()).directions
        return question_focal_lengths(source, directions, options)


def checks(one: Turned | Focal) -> list[Check]:
    """Return the limits of one scene."""
    if isinstance(one, Focal):
        return [
            Check(name="named", value=one.num_named / one.num_asked, limit=1.0, better="higher"),
            Check(name="false", value=one.num_false, limit=0),
        ]
    limits = [
        Check(name="blamed", value=one.num_blamed / one.num_cameras, limit=0.01),
        Check(name="wrong kept", value=one.num_wrong_kept, limit=0),
        Check(name="kept at 2", value=one.kept[0] / one.turned[0], limit=0.02),
        Check(name="kept beyond", value=sum(one.kept[1:]), limit=0),
    ]
    if one.name.startswith("kerry-park"):
        limits.append(Check(name="registered", value=one.num_registered, limit=48, better="higher"))
    return limits


def tables(measured: Mapping[str, Any], _args: argparse.Namespace) -> Iterator[str]:
    yield "## Rotations"
    found = [one for one in measured.values() if isinstance(one, Turned)]
    columns: dict[str, Any] = {
        "scene": lambda one: one.name,
        "cameras": lambda one: str(one.num_cameras),
        "right ones left out": lambda one: str(one.num_blamed),
        "wrong ones kept": lambda one: f"{one.num_wrong_kept} of {one.num_wrong}",
    }
    for k, angle in enumerate(ANGLES_DEG):
        columns[f"kept at {angle:g} deg"] = lambda one, k=k: f"{one.kept[k]} of {one.turned[k]}"
    columns["others left out"] = lambda one: number(one.others_blamed)
    yield table_of(found, columns | {"verdict": lambda one: verdict(checks(one))})
    yield "## Focal lengths"
    yield table_of(
        [one for one in measured.values() if isinstance(one, Focal)],
        {
            "scene": lambda one: one.name,
            "named": lambda one: f"{one.num_named} of {one.num_asked}",
            "falsely": lambda one: str(one.num_false),
            "verdict": lambda one: verdict(checks(one)),
        },
    )


BENCHMARK = Benchmark(
    name="doubt",
    title="Doubt",
    cases=cases,
    checks=checks,
    tables=tables,
    quick={"repeats": 1},
    repeats=3,
    threads=2,
    quantities=(
        Quantity("right ones left out", "cameras", "lower", 0.0, "in the scene as it is"),
        Quantity("kept", "cameras", "lower", 0.0, "turned cameras that are trusted and delivered off"),
        Quantity(
            "others left out", "1", "lower", 0.01, "share of the right cameras, while others are turned"
        ),
        Quantity("named", "runs", "higher", 0.0, "in which the camera with the wrong focal length is named"),
        Quantity("falsely", "cameras", "lower", 0.0, "with a right focal length, and named"),
    ),
)
