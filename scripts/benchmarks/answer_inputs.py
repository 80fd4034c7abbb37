"""What the cases of `answers` are given: copies of scenes, and rigs, graphs and tables made from fixed seeds.

Everything is made by numpy, scipy and pycolmap alone, so that it does not depend on the code whose answers
are recorded. All stands below one folder:

    scenes/NAME/    sparse/0, database.db, the truth; tables made from the truth: priors.txt, gravity.txt,
                    control.txt, and names of images and pairs
    graphs/         bare graphs and relative poses
"""

import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

MADRID = "1dsfm-Madrid_Metropolis"
TRUTHS = ("gt", "truth", "sparse/0")
_PARTS = ("sparse/0", "database.db", "gt", "truth", "global", "gps.csv")
_PAIR_BASE = 2147483647  # COLMAP's pair_id is id1 * this + id2
_PRUNED: dict[str, Callable[[int, int], bool]] = {
    "ring8-hinged": lambda i, j: {i, j} <= {1, 2, 3, 4} or {i, j} <= {4, 5, 6, 7, 8},
    "ring8-pendant": lambda i, j: 1 not in (i, j) or (i, j) == (1, 2),
    "ring8-cycle": lambda i, j: j - i in (1, 7),
    "ring8-apart": lambda i, j: (i <= 4) == (j <= 4),
    "courtyard-hinged": lambda i, j: max(i, j) <= 13 or min(i, j) >= 13,
}
"""Which pairs of images are kept, of the scene before the hyphen."""
_EXTENDED = ("courtyard", "photographed")
"""Scenes of whose truth a third of the images become new ones, posed by their rotations alone."""
_GUESSED = {"ring8": 0.85, "photographed": 1.2}
"""Scenes whose lens becomes a guess: focal length over the true one; distortion 0."""
MADE = {
    **{"rig": "truth", "ring8-few": "sparse/0", "courtyard-broken": "truth"},
    **{name: "truth" if name.startswith("courtyard") else "sparse/0" for name in _PRUNED},
    **{f"{name}-new": "truth" for name in _EXTENDED},
    **{f"{name}-guessed": "truth" for name in _GUESSED},
}
"""Scenes that are made, not copied, and which of their models is the truth."""


def truth_of(folder: Path) -> str:
    """Return which of a scene's models is the best there is."""
    return next(name for name in TRUTHS if (folder / name).is_dir())


def make_inputs(work: Path, scenes: Mapping[str, Path]) -> None:
    """Copy scenes given by name and folder, and make everything else; the bundled must be among them."""
    (work / "graphs").mkdir()
    for name, folder in scenes.items():
        if name == MADRID:
            shutil.copytree(folder, work / "graphs" / name, copy_function=shutil.copyfile)
        else:
            _copy(folder, work / "scenes" / name)
    shutil.copyfile(scenes["ring8"].with_name("graph40.txt"), work / "graphs" / "graph40.txt")
    for name in MADE:
        source, _, _ = name.partition("-")
        if source in scenes:
            _copy(scenes[source], work / "scenes" / name)
    for name, kept in _PRUNED.items():
        _keep_pairs(work / "scenes" / name / "database.db", kept)
    for name in _EXTENDED:
        _forget_some(work / "scenes" / f"{name}-new")
    for name, factor in _GUESSED.items():
        _guess_lenses(work / "scenes" / f"{name}-guessed", factor)
    _keep_few_matches(work / "scenes" / "ring8-few" / "database.db")
    _break_some(work / "scenes" / "courtyard-broken")
    _make_rig(work / "scenes" / "rig")
    for folder in sorted((work / "scenes").iterdir()):
        _write_tables(folder)
    _write_graphs(work / "graphs")
    _write_relative_poses(work / "graphs")
    (work / "told.toml").write_text('min_trust = 0.0\nknown_distance = ["0001.jpg", "0003.jpg", 2.5]\n')
    (work / "wrong.toml").write_text("min_rust = 0.0\n")
    (work / "full").mkdir()
    (work / "full" / "mine.txt").write_text("not to be replaced\n")
    (work / "empty").mkdir()


def _copy(source: Path, target: Path) -> None:
    """Copy what the cases read of a scene, without its modes: the copy may be written."""
    for part in _PARTS:
        files = [source / part] if (source / part).is_file() else sorted((source / part).glob("*"))
        for file in files:
            copied = target / file.relative_to(source)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copied)


def _keep_pairs(database: Path, wanted: Callable[[int, int], bool]) -> None:
    connection = sqlite3.connect(database)
    ids = [pair for (pair,) in connection.execute("SELECT pair_id FROM two_view_geometries")]
    dropped = [(pair,) for pair in ids if not wanted(*divmod(pair, _PAIR_BASE))]
    connection.executemany("DELETE FROM two_view_geometries WHERE pair_id = ?", dropped)
    connection.commit()
    connection.close()


def _forget_some(folder: Path) -> None:
    """Let sparse/0 be the truth in which the last third of the images have no points and no place."""
    model = pycolmap.Reconstruction(folder / "truth")
    for image_id in sorted(model.images)[-(len(model.images) // 3) :]:
        image = model.image(image_id)
        for index in [k for k, point in enumerate(image.points2D) if point.has_point3D()]:
            if model.image(image_id).point2D(index).has_point3D():  # a track of two goes as a whole
                model.delete_observation(image_id, index)
        frame = model.frame(image.frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.zeros(3))
    model.write(folder / "sparse" / "0")


def _guess_lenses(folder: Path, factor: float) -> None:
    """Let all focal lengths of sparse/0 and the database be guesses; the truth is what sparse/0 was."""
    if not (folder / "truth").is_dir():
        shutil.copytree(folder / "sparse" / "0", folder / "truth")
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    connection = sqlite3.connect(folder / "database.db")
    for camera in model.cameras.values():
        params = np.array(camera.params)
        params[camera.focal_length_idxs()] *= factor
        params[camera.extra_params_idxs()] = 0.0
        camera.params, camera.has_prior_focal_length = params, False
        connection.execute(
            "UPDATE cameras SET params = ?, prior_focal_length = 0 WHERE camera_id = ?",
            (params.astype("<f8").tobytes(), camera.camera_id),
        )
    connection.commit()
    connection.close()
    model.write(folder / "sparse" / "0")


def _keep_few_matches(database: Path) -> None:
    """Of the pairs between the first four images and the others, leave 12 matches of six, none of others."""
    rng = np.random.default_rng(0)
    connection = sqlite3.connect(database)
    rows = connection.execute("SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0").fetchall()
    between = [row for row in rows if len({image <= 4 for image in divmod(row[0], _PAIR_BASE)}) == 2]
    for rank, (pair, count, data) in enumerate(sorted(between, key=lambda row: (-row[1], row[0]))):
        matches = np.frombuffer(data, np.uint32).reshape(-1, 2)[rng.permutation(count)[: 12 * (rank < 6)]]
        connection.execute(
            "UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?",
            (len(matches), matches.tobytes(), pair),
        )
    connection.commit()
    connection.close()


def _break_some(folder: Path) -> None:
    """Let sparse/0 be the truth in which every eighth image is moved or turned, its points left alone."""
    model = pycolmap.Reconstruction(folder / "truth")
    rng = np.random.default_rng(5)
    for rank, image_id in enumerate(sorted(model.images)[::8]):
        frame = model.frame(model.image(image_id).frame_id)
        turn = Rotation.from_rotvec(np.radians(rank % 2) * rng.standard_normal(3))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), rng.normal(0.0, 0.2, 3))
        frame.rig_from_world = pose * frame.rig_from_world
    model.update_point_3d_errors()
    model.write(folder / "sparse" / "0")


def _make_rig(folder: Path) -> None:
    """Make two rigs of three cameras; sparse/0 states rotations only, offsets of sensors the scale."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2,
        num_cameras_per_rig=3,
        num_frames_per_rig=6,
        num_points3D=300,
        sensor_from_rig_translation_stddev=0.5,
        sensor_from_rig_rotation_stddev=10.0,
        two_view_geometry_has_relative_pose=True,
        inlier_match_ratio=0.9,
        prior_position=True,
    )
    noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5, prior_position_stddev=0.1)
    for name in ("truth", "sparse/0"):
        (folder / name).mkdir(parents=True)
    pycolmap.set_random_seed(1)
    with pycolmap.Database.open(folder / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, model, database)
    model.write(folder / "truth")
    for frame in model.frames.values():
        frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.zeros(3))
    for point in list(model.points3D):
        model.delete_point3D(point)
    model.write(folder / "sparse" / "0")


def _write_tables(folder: Path) -> None:
    """Write what a user may tell of a scene: noisy positions, one of them far off, gravity, names, marks."""
    model = pycolmap.Reconstruction(folder / truth_of(folder))
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    centers = {name: posed[name].projection_center() for name in sorted(posed)}
    extent = float(np.ptp(list(centers.values()), axis=0).max())
    rng = np.random.default_rng(7)
    priors, gravity = [], []
    for k, (name, center) in enumerate(centers.items()):
        off = rng.normal(0.0, 0.005 * extent, 3) + (extent if k == 2 else 0.0)
        priors.append(_line(name, *(center + off), 0.005 * extent))
    for name in centers:
        down = posed[name].cam_from_world().rotation.matrix() @ [0.0, 0.0, -1.0]
        gravity.append(_line(name, *(down + rng.normal(0.0, 0.01, 3))))
    (folder / "priors.txt").write_text("".join(priors))
    (folder / "gravity.txt").write_text("".join(gravity))
    names = list(centers)
    (folder / "fixed.txt").write_text("".join(f"{name}\n" for name in names[::3]))
    (folder / "pairs.txt").write_text("".join(f"{a} {b}\n" for a, b in pairwise(names[:4])))
    (folder / "control.txt").write_text("".join(["local\n", *_control_lines(model, extent, rng)]))


def _control_lines(model: pycolmap.Reconstruction, extent: float, rng: np.random.Generator) -> Iterator[str]:
    """Yield the marks of six points that many images see, in other axes; the last point only checks."""
    seen = sorted(model.points3D, key=lambda k: (-model.point3D(k).track.length(), k))
    xyz = np.array([model.point3D(k).xyz for k in seen]).reshape(-1, 3)
    chosen: list[int] = []
    for row in range(len(seen)):  # far from each other
        if len(chosen) < 6 and all(np.linalg.norm(xyz[row] - xyz[k]) > 0.05 * extent for k in chosen):
            chosen.append(row)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    for number, row in enumerate(chosen):
        place = 2.5 * turn.apply(xyz[row]) + [100.0, -200.0, 300.0]
        marks = model.point3D(seen[row]).track.elements
        for mark in sorted(marks, key=lambda mark: (mark.image_id, mark.point2D_idx)):
            image = model.image(mark.image_id)
            pixel = image.point2D(mark.point2D_idx).xy + rng.normal(0.0, 0.3, 2)
            yield _line(*place, *pixel, image.name, f"{'CHK-' if number == 5 else 'P'}{number}")


def _line(*words: Any) -> str:
    return " ".join(word if isinstance(word, str) else repr(float(word)) for word in words) + "\n"


def _write_graphs(folder: Path) -> None:
    rng = np.random.default_rng(11)
    for name, n, d, q in (("random300", 300, 3, 0.2), ("plane", 30, 2, 0.1), ("space5", 20, 5, 0.0)):
        t = rng.standard_normal((n, d))
        share = min(1.0, 20 / n)
        pairs = [(i, j) for i in range(n) for j in range(i) if rng.random() < share or i - j < 3]
        (folder / f"{name}.txt").write_text(_graph_text(t, pairs, rng, 0.005, q))
    chain = np.cumsum(rng.normal([1.0, 0.0, 0.0], 0.3, (200, 3)), axis=0)
    near = [(i, j) for i in range(200) for j in range(max(0, i - 8), i)]
    (folder / "chain.txt").write_text(_graph_text(chain, near, rng, 0.01, 0.1, weighted=True))
    box = rng.random((600, 3))
    nearest = np.argsort(np.linalg.norm(box[:, None] - box, axis=2), axis=1, kind="stable")[:, 1:25]
    pairs = sorted({(max(i, j), min(i, j)) for i in range(600) for j in nearest[i].tolist()})
    (folder / "box.txt").write_text(_graph_text(box, pairs, rng, 0.01, 0.2))
    groups = [range(12), range(11, 18), range(18, 21)]  # the second hangs at node 11, the third at nothing
    pairs = [(i, j) for group in groups for i in group for j in group if j < i]
    (folder / "pieces.txt").write_text(_graph_text(rng.standard_normal((21, 3)), pairs, rng, 0.002, 0.0))
    (folder / "malformed.txt").write_text("0 1 1 0 0\n1 2 0 1\n")
    (folder / "cycle.txt").write_text(
        _graph_text(rng.standard_normal((6, 3)), [(i, (i + 1) % 6) for i in range(6)], rng, 0.0, 0.0)
    )


def _graph_text(
    t: np.ndarray,
    pairs: Iterable[tuple[int, int]],
    rng: np.random.Generator,
    sigma: float,
    q: float,
    weighted: bool = False,
) -> str:
    """Return a bare graph: noise of standard deviation sigma (rad), a share q of random directions."""
    lines = []
    for i, j in pairs:
        v = _noisy(t[i] - t[j], rng, sigma, q)
        lines.append(_line(str(i), str(j), *v, *([rng.uniform(0.2, 2.0)] if weighted else [])))
    return "".join(lines)


def _noisy(v: np.ndarray, rng: np.random.Generator, sigma: float, q: float) -> np.ndarray:
    v = rng.standard_normal(len(v)) if rng.random() < q else v / np.linalg.norm(v)
    v = v + rng.normal(0.0, sigma, len(v))
    return v / np.linalg.norm(v)


def _write_relative_poses(folder: Path) -> None:
    """Write the same relative poses as a 1DSfM folder, as g2o and as GLOMAP's text, with some noise."""
    rng = np.random.default_rng(13)
    n = 15
    rotations, centers = Rotation.random(n, rng), rng.standard_normal((n, 3))
    bundler = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))  # 1DSfM's camera axes: y up, along -z
    egs, g2o, text = [], [], []
    for i in range(n):
        for j in range(i + 1, n):
            error = Rotation.from_rotvec(rng.normal(0.0, 0.002, 3))
            relative = rotations[i] * error * rotations[j].inv()  # cam_i_from_cam_j
            to_j = rotations[i].apply(_noisy(centers[j] - centers[i], rng, 0.002, 0.1))
            turned = (bundler * relative * bundler).as_matrix().ravel()
            egs.append(_line(str(i), str(j), *turned, *bundler.apply(to_j)))
            g2o.append(_line("EDGE_SE3:QUAT", str(i), str(j), *to_j, *relative.as_quat()))
            x, y, z, w = relative.inv().as_quat()
            text.append(_line(f"n{i}", f"n{j}", w, x, y, z, *relative.inv().apply(-to_j)))
    vertices = [
        _line("VERTEX_SE3:QUAT", str(k), *centers[k], *rotations[k].inv().as_quat()) for k in range(n)
    ]
    (folder / "1dsfm").mkdir()
    (folder / "1dsfm" / "EGs.txt").write_text("".join(egs))
    known = [_line(str(k), *(bundler * rotations[k]).as_matrix().ravel()) for k in range(n)]
    (folder / "1dsfm" / "rots.txt").write_text("".join(known))
    (folder / "poses.g2o").write_text("".join(vertices + g2o))
    (folder / "poses.txt").write_text("".join(text))
