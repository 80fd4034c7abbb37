"""Damage to what other programs and people write: their models, databases without a model, tables beside.

Each `damaged_*` takes the folder of sound files, that of a case, and a generator, and returns a label and the
arguments of the command line; `write_models` and `write_tables` make the sound files.
"""

import json
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from abuse import databases, mutations

_MODELS = {
    "openmvg/sfm_data.json": (),
    "opensfm/reconstruction.json": ("opensfm/tracks.csv",),
    "bundler/bundle.out": ("bundler/list.txt",),
}
"""Files of other programs, and what stands beside them."""
_TABLES = {"priors.txt": "--priors", "fix.txt": "--fix", "options.toml": "--config"}
_CAMERA_COLUMNS = ("camera_id", "model", "width", "height", "params", "prior_focal_length")
_TEXT_WAYS: tuple[Callable[[bytes, Generator], bytes], ...] = (
    *(mutations.change_words, mutations.change_words, mutations.change_lines),
    *(mutations.cut_at_word, mutations.change_bytes),
)

Damage = tuple[str, tuple[str, ...]]


def write_models(model: Any, folder: Path) -> None:
    """Write a pycolmap reconstruction of pinhole cameras as openMVG, OpenSfM and Bundler do."""
    (camera,) = model.cameras.values()
    f, width, height = float(camera.params[0]), camera.width, camera.height
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    for name, text in {
        "openmvg/sfm_data.json": _openmvg(model, images, f, width, height),
        "opensfm/reconstruction.json": _opensfm(model, images, f, width, height),
        "opensfm/tracks.csv": _tracks(model, width, height),
        "bundler/bundle.out": _bundler(model, images, f, width, height),
        "bundler/list.txt": "".join(f"{image.name}\n" for image in images),
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def write_tables(model: Any, folder: Path) -> None:
    """Write position priors, names of images that stay, and options."""
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    rows = [f"{image.name} {_words(image.projection_center())} 0.1\n" for image in images]
    (folder / "priors.txt").write_text("name x y z sigma\n" + "".join(rows))
    (folder / "fix.txt").write_text("".join(f"{image.name}\n" for image in images[:3]))
    (folder / "options.toml").write_text('threads = 1\nsolver = "newton"\nmin_inliers = 15\ntol = 1e-8\n')


def _openmvg(model: Any, images: list[Any], f: float, width: int, height: int) -> str:
    size: dict[str, Any] = {"width": width, "height": height}
    pinhole = {**size, "focal_length": f, "principal_point": [width / 2, height / 2]}
    lens = {"value0": pinhole, "disto_k3": [0.0, 0.0, 0.0]}
    views, poses, points = [], [], []
    for k, image in enumerate(images):
        view = {**size, "filename": image.name, "id_view": k, "id_intrinsic": 0, "id_pose": k}
        views.append({"key": k, "value": {"ptr_wrapper": {"data": view}}})
        rotation = image.cam_from_world().rotation.matrix().tolist()
        center = image.projection_center().tolist()
        poses.append({"key": k, "value": {"rotation": rotation, "center": center}})
    index = {image.image_id: k for k, image in enumerate(images)}
    for key, point in model.points3D.items():
        seen = [
            {"key": index[image], "value": {"id_feat": number, "x": xy}}
            for image, number, xy in _observations(model, point)
        ]
        points.append({"key": key, "value": {"X": point.xyz.tolist(), "observations": seen}})
    intrinsic = {"polymorphic_name": "pinhole_radial_k3", "ptr_wrapper": {"data": lens}}
    content = {
        "sfm_data_version": "0.3",
        "root_path": "",
        "views": views,
        "intrinsics": [{"key": 0, "value": intrinsic}],
        "extrinsics": poses,
        "structure": points,
    }
    return json.dumps(content, indent=1)


def _opensfm(model: Any, images: list[Any], f: float, width: int, height: int) -> str:
    shots = {
        image.name: {
            "rotation": Rotation.from_quat(image.cam_from_world().rotation.quat).as_rotvec().tolist(),
            "translation": image.cam_from_world().translation.tolist(),
            "camera": "c",
        }
        for image in images
    }
    camera = {"projection_type": "perspective", "width": width, "height": height}
    lens = {"focal": f / max(width, height), "k1": 0.0, "k2": 0.0}
    points = {
        str(key): {"coordinates": p.xyz.tolist(), "color": [1, 2, 3]} for key, p in model.points3D.items()
    }
    return json.dumps([{"cameras": {"c": camera | lens}, "shots": shots, "points": points}], indent=1)


def _tracks(model: Any, width: int, height: int) -> str:
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for key, point in model.points3D.items():
        for image, number, (x, y) in _observations(model, point):
            u, v = (x - width / 2) / max(width, height), (y - height / 2) / max(width, height)
            lines.append(f"{model.images[image].name}\t{key}\t{number}\t{u!r}\t{v!r}\t0.01\t1\t2\t3\t-1\t-1")
    return "\n".join(lines) + "\n"


def _bundler(model: Any, images: list[Any], f: float, width: int, height: int) -> str:
    lines, flip = ["# Bundle file v0.3", f"{len(images)} {len(model.points3D)}"], np.diag([1.0, -1.0, -1.0])
    index = {image.image_id: k for k, image in enumerate(images)}
    for image in images:
        pose = image.cam_from_world()
        rows = [*(flip @ pose.rotation.matrix()), flip @ pose.translation]
        lines += [f"{f!r} 0 0", *(_words(row) for row in rows)]
    for point in model.points3D.values():
        seen = list(_observations(model, point))
        views = [f"{index[i]} {k} {x - width / 2!r} {height / 2 - y!r}" for i, k, (x, y) in seen]
        lines += [_words(point.xyz), "1 2 3", " ".join([str(len(views)), *views])]
    return "\n".join(lines) + "\n"


def _observations(model: Any, point: Any) -> list[tuple[int, int, list[float]]]:
    """Return the image, the number and the pixel of each observation of a point."""
    elements = [(element.image_id, element.point2D_idx) for element in point.track.elements]
    return [(i, k, model.images[i].points2D[k].xy.tolist()) for i, k in elements]


def _words(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))


def damage_stranger(base: Path, folder: Path, rng: Generator) -> Damage:
    """A damaged model of another program, or a damaged list beside it."""
    source = str(mutations.pick(rng, sorted(_MODELS)))
    shutil.copytree((base / source).parent, (folder / source).parent)
    target = str(mutations.pick(rng, (source, source, *_MODELS[source])))
    path = folder / target
    if path.suffix == ".json" and rng.random() < 0.8:
        label, data = "json", _change_json(path.read_bytes(), rng)
    else:
        way = mutations.pick(rng, _TEXT_WAYS)
        label, data = way.__name__, way(path.read_bytes(), rng)
    path.write_bytes(data)
    commands = (
        *[("locate", source, "out", "--threads", "1")] * 3,
        *(("convert", source, out) for out in ("out", "out.json", "out.csv")),
        *(("inspect", source), ("evaluate", source, "truth")),
    )
    command = mutations.pick(rng, commands)
    if command[0] == "evaluate":
        shutil.copytree(base / "truth", folder / "truth")
    return f"stranger: {target} {label}", command


def damage_database(base: Path, folder: Path, rng: Generator) -> Damage:
    """A damaged database alone, from which `map` takes cameras and rotations too."""
    shutil.copyfile(base / "database.db", folder / "database.db")
    way = mutations.pick(rng, (*databases.WAYS, odd_cameras, odd_cameras, odd_cameras))
    way(folder / "database.db", rng)
    relative = ("--relative", "stored") if rng.random() < 0.3 else ()
    return f"map: {way.__name__}", ("map", "database.db", "out", *relative, "--threads", "1")


def odd_cameras(path: Path, rng: Generator) -> bool:
    """Change the intrinsics in a database: their type, their values, their number."""
    column = str(mutations.pick(rng, (*_CAMERA_COLUMNS, "params", "params")))
    doubles = [struct.pack("<d", value) for value in mutations.DOUBLES]
    value = mutations.pick(rng, databases.ODD_VALUES)
    with closing(sqlite3.connect(path)) as connection:
        (params,) = connection.execute("SELECT params FROM cameras").fetchone()
        if column == "params" and rng.random() < 0.7:
            at = 8 * int(rng.integers(len(params) // 8))
            value = params[:at] + bytes(mutations.pick(rng, doubles)) + params[at + 8 :]
            if rng.random() < 0.2:
                value = value[: int(rng.integers(len(value)))]
        names = ", ".join(_CAMERA_COLUMNS)
        connection.execute(f"CREATE TABLE untyped ({names})")
        connection.execute(f"INSERT INTO untyped SELECT {names} FROM cameras")
        connection.execute("DROP TABLE cameras")
        connection.execute("ALTER TABLE untyped RENAME TO cameras")
        connection.execute(f"UPDATE cameras SET {column} = ?", (value,))
        if rng.random() < 0.1:
            connection.execute("INSERT INTO cameras SELECT * FROM cameras")
        connection.commit()
    return False


def damage_table(base: Path, folder: Path, rng: Generator) -> Damage:
    """A damaged table of priors, of names or of options beside a sound model."""
    name = str(mutations.pick(rng, sorted(_TABLES)))
    shutil.copytree(base / "sparse", folder / "sparse")
    for sound in ("database.db", name):
        shutil.copyfile(base / sound, folder / sound)
    way = mutations.pick(rng, _TEXT_WAYS)
    (folder / name).write_bytes(way((folder / name).read_bytes(), rng))
    refine = ("--refine-with-priors",) if name == "priors.txt" and rng.random() < 0.5 else ()
    arguments = ("locate", "sparse/0", "out", "--database", "database.db", _TABLES[name], name, *refine)
    threads = () if name == "options.toml" else ("--threads", "1")
    return f"table: {name} {way.__name__}", (*arguments, *threads)


def _change_json(data: bytes, rng: Generator) -> bytes:
    """Replace, remove or repeat one to three values somewhere in a JSON file."""
    content = json.loads(data)
    for _ in range(int(rng.integers(1, 4))):
        holder, key = _random_place(content, rng)
        if rng.random() < 0.25:
            del holder[key]
        else:
            odd = (None, True, [], {}, [[]], *mutations.INTEGERS, *mutations.DOUBLES, *mutations.WORDS)
            holder[key] = mutations.pick(rng, (*odd, [holder[key]] * 2))
        if not content:
            break
    return json.dumps(content).encode("utf-8", errors="surrogatepass")


def _random_place(content: Any, rng: Generator) -> tuple[Any, Any]:
    """Return a container inside a JSON value and one of its keys or indices, found by a walk down."""
    holder = content
    while True:
        keys = [*holder] if isinstance(holder, dict) else [*range(len(holder))]
        key = mutations.pick(rng, keys)
        below = holder[key]
        if not isinstance(below, dict | list) or not below or rng.random() < 0.15:
            return holder, key
        holder = below
