"""Matches between the pictures of a report, of every command that has some."""

import shutil

import numpy as np
import pycolmap
import pytest

from sfm_shapefit import check, join, locate, map_database
from sfm_shapefit.report.matched import MOST_DRAWN
from tests.report.test_report_page import data_of, unpacked
from tests.scenes import COURTYARD, RING


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A gray picture of each image; what is on them does not matter."""
    cv2 = pytest.importorskip("cv2")
    folder = tmp_path_factory.mktemp("pictures")
    for image in pycolmap.Reconstruction(
        COURTYARD / "sparse/0"
    ).images.values():  # the ring has the first eight
        cv2.imwrite(str(folder / image.name), np.full((30, 40), 128, dtype=np.uint8))
    return folder


def told_matches(found, page, pictures):
    """Return the matches on the page of a result: by pair of names, counts, drawn ones, and places."""
    found.report(page, images=pictures)
    data = data_of(page.read_text(encoding="utf-8"))
    names, ends = data["cameras"]["names"], [unpacked(data["pairs"][end]) for end in ("first", "second")]
    columns = {key: unpacked(data["matches"][key]) for key in ("pair", "counts", "drawn", "places")}
    counts, drawn = (columns[key].reshape(-1, 2).astype(int) for key in ("counts", "drawn"))
    places = np.split(columns["places"].reshape(-1, 4) / 65535.0, np.cumsum(drawn.sum(axis=1))[:-1])
    pairs = [(names[ends[0][p]], names[ends[1][p]]) for p in columns["pair"].tolist()]
    return {pair: told for pair, *told in zip(pairs, counts, drawn, places, strict=True)}


def test_matches_are_those_of_the_database_and_contradict_where_they_miss_epipolar_lines(
    courtyard_located, tmp_path, pictures
):
    found = courtyard_located
    told = told_matches(found, tmp_path / "page.html", pictures)
    model = found.reconstruction
    images = {image.name: image for image in model.images.values()}
    shutil.copy(COURTYARD / "database.db", tmp_path)  # to be opened by pycolmap changes the file
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for (first, second), (counts, drawn, places) in told.items():
            one, other = images[first], images[second]
            rows = database.read_two_view_geometry(one.image_id, other.image_id).inlier_matches
            ends = [database.read_keypoints(image.image_id)[:, :2] for image in (one, other)]
            xy = [ends[side][rows[:, side]] for side in (0, 1)]
            assert counts.sum() == len(np.unique(rows, axis=0))
            assert drawn.sum() == min(counts.sum(), MOST_DRAWN)
            sizes = [[image.camera.width, image.camera.height] for image in (one, other)]
            every = np.concatenate([xy[side] / sizes[side] for side in (0, 1)], axis=1)
            misses = np.abs(every[None] - places[:, None]).max(axis=2).min(axis=1)
            assert misses.max() < 1.0 / 65535  # each is a match of the pair, its first camera first
            errors, most = sampson_px(one, other, xy)
            assert np.sum(errors < 4.0) <= counts[0] <= np.sum(errors < most * 4.0)
    assert sum(counts[1] for counts, _, _ in told.values()) > 0


def sampson_px(one, other, xy):
    """Sampson errors in pixels of matches by the model's poses on the image plane.

    And by which factor, at most, they are larger there than on the sphere: 1 / cos^2 in the corners.
    """
    motion = other.cam_from_world() * one.cam_from_world().inverse()
    x, y, z = motion.translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion.rotation.matrix()
    a, b = (
        np.append(image.camera.cam_from_img(pixels), np.ones((len(pixels), 1)), axis=1)
        for image, pixels in zip((one, other), xy, strict=True)
    )
    lines = [b @ essential, a @ essential.T]
    size = np.sqrt(sum(np.sum(line[:, :2] ** 2, axis=1) for line in lines))
    most = max(np.sum(rays**2, axis=1).max() for rays in (a, b))
    return one.camera.mean_focal_length() * np.abs(np.sum(b * lines[1], axis=1)) / size, most


def test_every_command_has_matches_and_without_a_database_those_of_the_points(
    ring_mapped, tmp_path, pictures
):
    shutil.copytree(RING / "sparse/0", tmp_path / "model")
    first, *_, last = sorted(ring_mapped.image_names)
    halves = [pycolmap.Reconstruction(RING / "sparse/0") for _ in range(2)]
    for half, gone in zip(halves, (first, last), strict=True):
        half.deregister_frame(next(i.frame_id for i in half.images.values() if i.name == gone))
    results = {
        "map": ring_mapped,
        "check": check(RING / "sparse/0", second_opinion=False),
        "join": join(halves, RING / "database.db"),
        "tracks": locate(tmp_path / "model"),
    }
    for name, found in results.items():
        told = told_matches(found, tmp_path / f"{name}.html", pictures)
        fit, against = np.sum([counts for counts, _, _ in told.values()], axis=0)
        assert len(told) > 8
        assert fit > 100
        assert against < 0.3 * fit


def test_a_database_that_is_gone_leaves_the_pictures_alone(tmp_path, pictures):
    shutil.copy(RING / "database.db", tmp_path / "database.db")
    found = map_database(tmp_path / "database.db")
    (tmp_path / "database.db").unlink()
    found.report(tmp_path / "page.html", images=pictures)
    data = data_of((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert data["matches"] is None
    assert sum(picture is not None for picture in data["pictures"]) == len(data["pictures"])
