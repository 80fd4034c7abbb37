"""One image, several names: models, databases, lists and references of programs that write them otherwise."""

import json
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm_shapefit import check, evaluate, join, locate, map_database
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.tables import read_trust
from sfm_shapefit.files.colmap.gravity import table_gravity
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.reconstructions import name_of
from sfm_shapefit.files.pair_list import read_pair_list
from tests.program import run, run_refused
from tests.scenes import BUNDLED, RING, edit_database, fingerprint

MODEL = Path("sparse") / "0"
DISTANCE = ("0001.jpg", "0005.jpg", 7.0)
Rename = Callable[[str], str | bytes]


def renamed(folder: Path, model: Rename, database: Rename) -> Path:
    """Return a copy of the ring whose images are called otherwise."""
    (folder / MODEL).mkdir(parents=True)
    copy = pycolmap.Reconstruction(RING / MODEL)
    rows = []
    for image in copy.images.values():
        rows.append((database(image.name), image.name))
        image.name = model(image.name)
    copy.write_binary(folder / MODEL)
    (folder / "database.db").write_bytes((RING / "database.db").read_bytes())
    change = "UPDATE images SET name = CAST(? AS TEXT) WHERE name = ?"
    edit_database(folder / "database.db", lambda connection: connection.executemany(change, rows))
    return folder


def gbk(name: str) -> bytes:
    """A name as COLMAP has it of a Chinese Windows: bytes that are no UTF-8."""
    return f"微信_{name}".encode("gbk")


@pytest.fixture(scope="module")
def placed() -> np.ndarray:
    """Centers of the ring as `locate` places it."""
    return locate(RING / MODEL, known_distance=[DISTANCE]).placed.centers


OTHERWISE: dict[str, tuple[Rename, Rename]] = {
    "composed and decomposed letters": (
        lambda name: f"Zo\u00eb_{name}",
        lambda name: unicodedata.normalize("NFD", f"Zo\u00eb_{name}"),
    ),
    "slashes of Windows": (lambda name: f"cam\\{name}", lambda name: f"cam/{name}"),
    "a folder more": (str, lambda name: f"./images/{name}"),
    "capital letters": (str, str.upper),
}


@pytest.mark.parametrize("case", OTHERWISE)
def test_a_model_and_its_database_may_call_images_otherwise(
    tmp_path: Path, case: str, placed: np.ndarray
) -> None:
    folder = renamed(tmp_path / "ring", *OTHERWISE[case])
    names = read_model(folder / MODEL).images.names
    found = locate(folder / MODEL, known_distance=[(names[0], names[4], DISTANCE[2])])
    assert found.placed.names == names
    assert np.array_equal(found.placed.centers, placed)
    if case == "a folder more":
        judged = check(folder / MODEL)
        assert judged.facts.evidence.second is not None
        assert judged.facts.evidence.second.num_common == 8


def test_names_that_are_no_utf8_go_through_every_command_as_bytes(tmp_path: Path) -> None:
    folder = renamed(tmp_path / "ring", gbk, gbk)
    before, model, out = fingerprint(folder), folder / MODEL, tmp_path / "out"
    names = {gbk(f"000{k}.jpg") for k in range(1, 9)}
    (tmp_path / "fixed.txt").write_bytes(b"\n".join(sorted(names)[:4]))
    run("locate", model, out, "--fix", tmp_path / "fixed.txt", code=0)
    run("map", folder / "database.db", tmp_path / "mapped", "-q", code=0)
    for written in (out, tmp_path / "mapped" / "0"):
        assert {name_of(image).encode("utf-8", "surrogateescape") for image in images(written)} == names
    report = tmp_path / "check.html"
    told = [
        run("check", model, "--json", "--report", report, code=0).stdout,
        run("inspect", model, "--json", code=0).stdout,
        run("evaluate", out, model, "--json", "--csv", tmp_path / "errors.csv", code=0).stdout,
        (out / "locate.json").read_text(encoding="utf-8"),
    ]
    for text in told:
        json.loads(text)
    assert r"\\xd0\\xc5_0001.jpg" in report.read_text(encoding="utf-8")
    assert set(read_trust(out / "cameras.csv")) == {name.decode("utf-8", "surrogateescape") for name in names}
    run("convert", out, tmp_path / "known.csv", "--format", "covariances", "-q", code=0)
    assert (tmp_path / "known.csv").read_bytes() == (out / "covariances.csv").read_bytes()
    for target in ("poses.json", "poses.csv", "poses.tum", "scene.glb", "scene.ply"):
        run("convert", out, tmp_path / target, "-q", code=0)
        if target.startswith("poses"):
            (tmp_path / target).read_text(encoding="utf-8")
    run("convert", out, tmp_path / "text", "--format", "colmap-txt", code=0)
    model = pycolmap.Reconstruction(out)
    min(model.images.values(), key=lambda image: image.image_id).name = "broken\nname.jpg"
    model.write(tmp_path)
    said = run_refused("convert", tmp_path, tmp_path / "lines", "--format", "colmap-txt")
    assert r"the name of image 'broken\nname.jpg' has a line break" in said
    assert not (tmp_path / "lines").exists()
    assert evaluate(tmp_path / "text", out).position.max < 1e-9
    run("locate", tmp_path / "poses.json", tmp_path / "again", "--database", folder / "database.db", code=0)
    for path in (*out.glob("*.csv"), *out.glob("*.html"), tmp_path / "errors.csv"):
        path.read_text(encoding="utf-8")
    assert fingerprint(folder) == before


def images(folder: Path) -> list[pycolmap.Image]:
    model = pycolmap.Reconstruction(folder)
    return [model.image(i) for i in model.reg_image_ids()]


def test_lists_may_call_images_otherwise_than_the_model(tmp_path: Path, placed: np.ndarray) -> None:
    model = read_model(RING / MODEL)
    names = model.images.names
    (tmp_path / "pairs.txt").write_text(".\\images\\0001.jpg D:/data/0003.jpg\n0002.JPG 0005.jpg\n")
    assert read_pair_list(tmp_path / "pairs.txt", names) == {(names[0], names[2]), (names[1], names[4])}
    plain = (BUNDLED / "gravity.txt").read_text()
    (tmp_path / "gravity.txt").write_text(re.sub("(?m)^00", r".\\images\\\\00", plain))
    expected = table_gravity(BUNDLED / "gravity.txt", model.images)
    assert np.array_equal(table_gravity(tmp_path / "gravity.txt", model.images).indices, expected.indices)
    (tmp_path / "fixed.txt").write_text("".join(f"images/{name}\n" for name in names[:4]))
    (tmp_path / "plain.txt").write_text("\n".join(names[:4]))
    fixed = [
        locate(model.reconstruction, RING / "database.db", fix=str(tmp_path / f"{one}.txt"))
        for one in ("fixed", "plain")
    ]
    assert np.array_equal(fixed[0].placed.centers, fixed[1].placed.centers)
    found = locate(RING / MODEL, known_distance=[(f"C:\\x\\{DISTANCE[0]}", *DISTANCE[1:])])
    assert np.array_equal(found.placed.centers, placed)
    for listed, known, message in (
        ("0009.jpg 0001.jpg", names, "there is no image '0009.jpg'"),
        ("x.jpg c.jpg", ["a/x.jpg", "b/x.jpg", "c.jpg"], "x.jpg may be a/x.jpg or b/x.jpg; give whole names"),
    ):
        (tmp_path / "pairs.txt").write_text(listed)
        with pytest.raises(InputError, match=re.escape(message)):
            read_pair_list(tmp_path / "pairs.txt", known)


def test_references_and_models_to_join_may_call_images_otherwise(tmp_path: Path) -> None:
    other = renamed(tmp_path / "other", lambda name: f"images\\{name}", str)
    found = evaluate(other / MODEL, RING / MODEL)
    assert len(found.names) == 8
    assert (found.missing, found.extra) == ((), ())
    halves = [tmp_path / "a", tmp_path / "b"]
    whole = map_database(RING / "database.db", min_model_size=3).models[0].reconstruction
    for half, folder in enumerate(halves):
        part = pycolmap.Reconstruction(whole)
        for image_id in sorted(part.images):
            number = int(part.image(image_id).name[:4])
            if not (number <= 5 if half == 0 else number >= 4 or number == 1):
                part.deregister_frame(part.image(image_id).frame_id)
        for image in part.images.values():
            image.name = f"images/{image.name}" if half else image.name
        folder.mkdir()
        part.write_binary(folder)
    joined = join(halves, RING / "database.db")
    posed = sorted(name_of(image) for image in joined.reconstruction.images.values() if image.has_pose)
    shared, alone = [f"000{k}.jpg" for k in range(1, 6)], [f"images/000{k}.jpg" for k in range(6, 9)]
    assert posed == [*shared, *alone]
    assert any("called otherwise" in warning for warning in joined.facts.warnings)


def test_a_database_called_colmap_is_found_beside_the_model(tmp_path: Path) -> None:
    folder = renamed(tmp_path / "ring", str, str)
    (folder / "database.db").rename(folder / "colmap.db")
    assert str(locate(folder / MODEL).inputs.database) == str(folder / "colmap.db")
    assert "colmap.db; 0 of 16" in run("map", folder, tmp_path / "mapped", code=0).stdout


def test_poses_serve_with_a_database_where_all_tracks_name_the_first_keypoint(tmp_path: Path) -> None:
    whole = map_database(RING / "database.db").models[0].reconstruction
    whole.write_text(tmp_path)
    plain = locate(tmp_path, RING / "database.db")
    file = tmp_path / "points3D.txt"
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    heads = [line.split()[:8] for line in lines]
    tracks = [[f"{image} 0" for image in line.split()[8::2]] for line in lines]
    file.write_text("\n".join(" ".join([*head, *track]) for head, track in zip(heads, tracks, strict=True)))
    found = locate(tmp_path, RING / "database.db")
    assert np.array_equal(found.placed.centers, plain.placed.centers)
    assert any("keypoint 0 of image" in warning and "left aside" in warning for warning in found.warnings)
    assert run("convert", tmp_path, tmp_path / "poses.tum", code=0).exit_code == 0
    assert "left aside, poses alone are read" in run("locate", tmp_path, tmp_path / "out", code=4).stderr
