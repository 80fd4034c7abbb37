"""`relative_rotations`: the same by threads and by workers, and bad input refused in a sentence."""

import dataclasses
import struct

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.model import read_model
from tests.lens_scene import camera_of_model, write_scene
from tests.scenes import COURTYARD, RING, copied, edit_database, fingerprint, read_from

DATABASE = COURTYARD / "database.db"


@pytest.fixture(scope="module")
def found():
    return sfm_shapefit.relative_rotations(DATABASE, threads=1)


def assert_same_bits(a, b):
    assert a.names == b.names
    for field in dataclasses.fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def test_pairs_are_positions_in_the_sorted_names(found):
    before = fingerprint(COURTYARD)
    assert found.names == tuple(sorted(read_from(DATABASE, read_images).images.names))
    i, j = found.pairs.T
    assert (i < j).all()
    assert (np.diff(i * len(found.names) + j) > 0).all()
    truth = read_model(COURTYARD / "sparse" / "0").images
    worst = found.subset(np.argsort(found.num_matches)[-1:])
    assert worst.names == found.names
    i, j = (truth.names.index(found.names[k]) for k in worst.pairs[0])
    true = truth.rotations[j] @ truth.rotations[i].T
    np.testing.assert_allclose(worst.rotations[0], true, atol=2e-3)
    assert fingerprint(COURTYARD) == before


def test_inlier_matches_are_enough(found, tmp_path):
    nothing = "UPDATE two_view_geometries SET E = NULL, F = NULL, H = NULL, qvec = NULL, tvec = NULL"
    path = edit_database(copied(COURTYARD, tmp_path) / "database.db", nothing)
    assert_same_bits(sfm_shapefit.relative_rotations(path), found)


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A ring of 56 images, each of which is matched with each, and the truth: very many pairs."""
    folder = tmp_path_factory.mktemp("crowded")
    write_scene(folder, [camera_of_model("PINHOLE")], 56)
    return folder / "database.db", read_model(folder / "sparse" / "0").images


def test_of_very_many_pairs_those_not_tried_for_are_found_near_their_average(crowded, dask_client):
    database, truth = crowded
    found = sfm_shapefit.relative_rotations(database, threads=1)
    assert len(found.pairs) > 25 * 56
    assert found.names == truth.names
    i, j = truth.rotations[found.pairs.T]
    off_deg = rotation_angles_deg(found.rotations @ (i @ j.transpose(0, 2, 1)))
    assert np.median(off_deg) < 0.1
    assert np.mean(off_deg < 1.0) > 0.98
    assert_same_bits(sfm_shapefit.relative_rotations(database, threads=2), found)
    assert_same_bits(sfm_shapefit.relative_rotations(database, client=dask_client), found)


@pytest.mark.parametrize("threads", [0, 2])
def test_threads_change_no_bit(found, threads):
    assert_same_bits(sfm_shapefit.relative_rotations(str(DATABASE), threads=threads), found)


def test_workers_change_no_bit(found, dask_client):
    seen = []
    tell = {"progress": lambda *now: seen.append(now)}
    shared = sfm_shapefit.relative_rotations(DATABASE, client=dask_client, **tell)
    many = sfm_shapefit.relative_rotations(DATABASE, client=dask_client, min_matches=60)
    assert_same_bits(shared, found)
    assert_same_bits(many, found.subset(found.num_matches >= 60))
    assert {stage for stage, _, _ in seen} == {"relative rotations"}
    assert seen[-1][1] == seen[-1][2]


@pytest.mark.parametrize("threads", [1, 2])
def test_an_interrupt_ends_the_work_after_the_batches_at_hand(threads):
    seen = []

    def interrupt(_stage, done, total):
        seen.append((done, total))
        if done > 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sfm_shapefit.relative_rotations(DATABASE, threads=threads, progress=interrupt)
    assert [done > 1 for done, _ in seen] == [False] * (len(seen) - 1) + [True]


@pytest.mark.parametrize(
    "statements",
    [
        ["DELETE FROM two_view_geometries"],
        ["UPDATE keypoints SET rows = 0, data = x''", "UPDATE two_view_geometries SET rows = 0, data = x''"],
        # SIMPLE_RADIAL, and all pixels lie where such a lens has no rays.
        [f"UPDATE cameras SET model = 2, params = x'{struct.pack('<4d', 1e3, 1e5, 0.0, -5.0).hex()}'"],
    ],
)
def test_a_database_without_matches_has_no_pairs(tmp_path, statements):
    path = edit_database(copied(RING, tmp_path) / "database.db", *statements)
    none = sfm_shapefit.relative_rotations(path)
    assert none.rotations.shape == (0, 3, 3)
    assert len(none.names) == 8


def test_other_bad_arguments_are_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        sfm_shapefit.relative_rotations(tmp_path / "none.db")
    with pytest.raises(ValueError, match="min_matches must be at least 1"):
        sfm_shapefit.relative_rotations(DATABASE, min_matches=0)
    with pytest.raises(ValueError, match="threads must"):
        sfm_shapefit.relative_rotations(DATABASE, threads=-1)
