"""Native panoramas against a cubemap rig of the same rendered yard, for `map` and pycolmap's global mapping.

From each place, six pictures of 90 degrees are drawn through one lens. As they are, they are the cubemap: a
rig of six sensors of one center, as COLMAP's example for panoramas makes it. Resampled, they are one
EQUIRECTANGULAR picture, 3.2 times as wide as a face. Noise and JPEG come after that, so that none has them
twice. SIFT keypoints, matches and their verification are pycolmap's, on the pictures of both kinds; nothing
else is told.

COLMAP's maintainers asked for such a comparison: https://github.com/colmap/colmap/pull/4541.
"""

import argparse
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap

import sfm_shapefit
from harness.driver import Benchmark, Case, positive
from harness.process import Timed, time_call
from harness.record import Row
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import fit_similarity_l1
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.synthetic import RenderedScene, RenderOptions, SceneOptions, make_rendered_scene
from sfm_shapefit.synthetic.rendering import Canvas, draw_image

PANORAMAS, CUBEMAPS, FISHEYES = "panoramas", "cubemap rig", "two fisheyes"
_NOISE, _QUALITY = 2.0, 92  # gray levels; of JPEG
_WIDTH = (
    3.2  # of a panorama, in sides of a face: as many pixels for a degree on the horizon as in a face's middle
)
_TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # to the face at the right
_TIP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # to the face above
FACES = np.array([np.linalg.matrix_power(_TURN, k) for k in range(4)] + [_TIP, _TIP.T])
"""(6, 3, 3) face_from_panorama."""


def flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--places", type=positive, default=12, help="in the yard")
    parser.add_argument("--side", type=positive, default=640, help="pixels of a face")


def cases(args: argparse.Namespace) -> dict[str, Case]:
    """Return both kinds of pictures."""
    return {kind: partial(measure, kind, args.places, args.side) for kind in (PANORAMAS, CUBEMAPS)}


def measure(kind: str, places: int, side: int) -> list[Row]:
    """Draw, match and place the pictures of a kind by both programs."""
    size = {"image_width": side, "image_height": side, "focal_length_px": side / 2}
    plain = RenderOptions(radial_k1=0.0, radial_k2=0.0, gray_noise=0.0, exposure_spread=0.0)
    scene = make_rendered_scene(SceneOptions(shape="courtyard", num_images=places, seed=5, **size), plain)
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        draw(kind, scene, Path(folder) / "images")
        count = match(kind, side, Path(folder) / "images", database)
        runs: dict[str, Callable[[], pycolmap.Reconstruction]] = {
            "pycolmap, global": lambda: map_globally(database, Path(folder)),
            "map": lambda: sfm_shapefit.map_database(database).reconstruction,
        }
        return [_judged(kind, name, count, scene.centers, time_call(run)) for name, run in runs.items()][::-1]


def draw(kind: str, scene: RenderedScene, folder: Path) -> None:
    """Write the pictures of all places: faces or fisheyes in a folder each, or panoramas.

    The two fisheyes look ahead and back; as all faces do, they have one center.
    """
    side = scene.options.image_width
    turned = np.concatenate([FACES @ rotation for rotation in scene.rotations])
    faces = replace(scene, rotations=turned, centers=np.repeat(scene.centers, 6, axis=0))
    canvas, noise = Canvas.of(scene), np.random.default_rng(0)
    for place in range(len(scene.centers)):
        pictures = [draw_image(faces, 6 * place + k, canvas).astype(np.float32) for k in range(6)]
        if kind != CUBEMAPS:
            turns = FACES[[0, 2]] if kind == FISHEYES else FACES[:1]
            pictures = [_resampled(pictures, _camera(kind, side), turn) for turn in turns]
        for k, picture in enumerate(pictures):
            noisy = picture + noise.normal(0.0, _NOISE, picture.shape)
            path = folder / f"{k}" / f"{place:04d}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            bgr = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[:, :, ::-1]
            cv2.imwrite(str(path), bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


def _resampled(faces: list[np.ndarray], camera: pycolmap.Camera, turn: FloatArray) -> np.ndarray:
    """Return the picture of a turned camera, sampled from six faces where each of its pixels looks."""
    side = len(faces[0])
    v, u = np.indices((camera.height, camera.width)) + 0.5
    rays = np.asarray(camera.cam_ray_from_img(np.column_stack([u.ravel(), v.ravel()]))) @ turn
    which = np.argmax(rays @ FACES[:, 2].T, axis=1).reshape(u.shape)
    found = np.empty((*u.shape, 3), dtype=np.float32)
    for k, face in enumerate(faces):
        in_face = rays @ FACES[k].T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = (side / 2 * (in_face[:, :2] / in_face[:, 2:] + 1.0) - 0.5).astype(np.float32)
        x, y = (part.reshape(u.shape) for part in xy.T)
        sampled = cv2.remap(face, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        found[which == k] = sampled[which == k]
    return found


def _camera(kind: str, side: int) -> pycolmap.Camera:
    if kind == PANORAMAS:
        size = 2 * round(_WIDTH * side / 2), round(_WIDTH * side / 2)
        return pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, *size)
    if kind == FISHEYES:  # 180 degrees fill the picture
        width = round(_WIDTH * side / 2)
        return pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", width / np.pi, width, width)
    return pycolmap.Camera.create_from_model_name(1, "PINHOLE", side / 2, side, side)


def match(kind: str, side: int, images: Path, database: Path) -> float:
    """Find keypoints, match and verify all pairs; return the mean number of inliers of a verified pair."""
    camera = _camera(kind, side)
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model, reader.camera_params = camera.model_name, ",".join(map(str, camera.params))
    extraction.num_threads, extraction.sift.max_num_features = 1, 12_000 if kind == PANORAMAS else 2_000
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    with quiet_log():
        pycolmap.extract_features(
            database,
            images,
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        if kind == CUBEMAPS:
            _mount(database)
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
        with pycolmap.Database.open(database) as opened:
            counts = [len(found.inlier_matches) for found in opened.read_two_view_geometries()[1]]
    return float(np.mean([count for count in counts if count >= verification.min_num_inliers]))


def _mount(path: Path) -> None:
    """Make the cameras of the six folders one rig, and the images of a place one frame."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        database.clear_frames()
        database.clear_rigs()
        sensors = {image.name[0]: image.data_id.sensor_id for image in images}
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(sensors["0"])
        for k in range(1, 6):
            rig.add_sensor(sensors[str(k)], pycolmap.Rigid3d(pycolmap.Rotation3d(FACES[k]), np.zeros(3)))
        database.write_rig(rig, use_rig_id=True)
        for place in sorted({Path(image.name).stem for image in images}):
            frame = pycolmap.Frame(frame_id=int(place) + 1, rig_id=1)
            for image in images:
                if Path(image.name).stem == place:
                    frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)


def map_globally(database: Path, folder: Path) -> pycolmap.Reconstruction:
    """Return the largest model that pycolmap's global mapping makes of a copy of the database."""
    copy = Path(shutil.copy(database, folder / "copy.db"))
    with quiet_log():
        models = pycolmap.global_mapping(copy, folder / "images", folder / "global")
    return max(models.values(), key=lambda model: model.num_reg_images())


def _judged(kind: str, name: str, inliers: float, truth: FloatArray, run: Timed) -> Row:
    """Return the row of a run; a place stands where its images do, all of which have one center."""
    posed = [image for image in run.found.images.values() if image.has_pose]
    of_place = np.array([int(Path(image.name).stem) for image in posed])
    placed = np.unique(of_place)
    centers = np.array([image.projection_center() for image in posed])
    found = np.array([centers[of_place == place].mean(axis=0) for place in placed])
    errors = np.linalg.norm(fit_similarity_l1(found, truth[placed]).apply(found) - truth[placed], axis=1)
    cells = {
        "pictures": kind,
        "by": name,
        "images": f"{len(posed)} of {run.found.num_images()}",
        "places": f"{len(placed)} of {len(truth)}",
        "inliers": f"{inliers:.0f}",
        "median (m)": f"{np.median(errors):.5f}",
        "worst (m)": f"{errors.max():.5f}",
        "points": f"{run.found.num_points3D():,}",
        "seconds": f"{run.wall_s:.1f}",
    }
    return Row(cells, more={"median": float(np.median(errors))})


BENCHMARK = Benchmark(
    name="panoramas",
    title="Panoramas",
    cases=cases,
    flags=flags,
    packages=("pycolmap", "numpy", "opencv-python-headless"),
    quick={"places": 4, "side": 192},
    threads=2,
    columns={
        "images, places": "placed, of all; a place has one panorama or six faces",
        "inliers": "matches of a verified pair, mean",
        "median (m), worst (m)": "distance of a place from the truth after a robust similarity",
        "points": "3D points of the model",
        "seconds": "wall-clock from the database on",
    },
)
