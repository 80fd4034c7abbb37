"""What the cases of `answers` are given: copies of scenes, and rigs, graphs and tables made from fixed seeds.

Everything is made by numpy, scipy and pycolmap alone, so that it does not depend on the code whose answers
are recorded. All stands below one folder:

    scenes/NAME/    sparse/0, database.db, the truth; priors.txt and fixed.txt made from the truth
    graphs/         bare graphs and relative poses
"""

import shutil
import sqlite3
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

MADRID = "1dsfm-Madrid_Metropolis"
TRUTHS = ("gt", "truth", "sparse/0")
_PARTS = ("sparse/0", "database.db", "gt", "truth", "gps.csv")
_PAIR_BASE = 2147483647  # COLMAP's pair_id is id1 * this + id2
_PRUNED: dict[str, Callable[[int, int], bool]] = {
    "ring8-hinged": lambda i, j: {i, j} <= {1, 2, 3, 4} or {i, j} <= {4, 5, 6, 7, 8},
    "ring8-pendant": lambda i, j: 1 not in (i, j) or (i, j) == (1, 2),
    "ring8-cycle": lambda i, j: j - i in (1, 7),
}
"""Which pairs of images of the ring are kept."""
_EXTENDED = ("courtyard", "photographed")
"""Of their truth a third of the images become new ones, posed by their rotations alone."""
MADE = ("rig", *_PRUNED, *(f"{name}-new" for name in _EXTENDED))
"""Scenes that are made, not copied."""


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
    for name, kept in _PRUNED.items():
        _copy(scenes["ring8"], work / "scenes" / name)
        _keep_pairs(work / "scenes" / name / "database.db", kept)
    for name in _EXTENDED:
        _copy(scenes[name], work / "scenes" / f"{name}-new")
        _forget_some(work / "scenes" / f"{name}-new")
    _make_rig(work / "scenes" / "rig")
    for folder in sorted((work / "scenes").iterdir()):
        _write_tables(folder)
    _write_graphs(work / "graphs")
    _write_relative_poses(work / "graphs")
    (work / "known.toml").write_text('min_trust = 0.0\nknown_distance = ["0001.jpg", "0003.jpg", 2.5]\n')
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
    """Write noisy priors, one of them far off, and the names of a third of the cameras."""
    model = pycolmap.Reconstruction(folder / truth_of(folder))
    centers = {i.name: i.projection_center() for i in model.images.values() if i.has_pose}
    extent = float(np.ptp(list(centers.values()), axis=0).max())
    rng = np.random.default_rng(7)
    lines = []
    for k, name in enumerate(sorted(centers)):
        off = rng.normal(0.0, 0.005 * extent, 3) + (extent if k == 2 else 0.0)
        lines.append(_line(name, *(centers[name] + off), 0.005 * extent))
    (folder / "priors.txt").write_text("".join(lines))
    (folder / "fixed.txt").write_text("".join(f"{name}\n" for name in sorted(centers)[::3]))


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
