"""Matches of a database and of a model's own tracks: what their views yield, whatever is kept in memory."""

import dataclasses
import pickle
import shutil
from contextlib import closing

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.lenses import rays_of
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.scene import matches as scene_matches
from sfm_shapefit.scene.matches import PLENTY, KeypointMatches, Matches, Reading
from tests.scenes import RING, edit_database

READINGS = {
    "all is kept": PLENTY,
    "no rays are kept": Reading(rays_bytes=0),
    "no matches are kept": Reading(keeps=False),
    "one pair at a time": Reading(batch=1),
    "nothing is kept": Reading(batch=100, rays_bytes=0, keeps=False),
}


@pytest.fixture(scope="module")
def model(tiny_ring):
    return read_model(tiny_ring / "sparse" / "0")


@pytest.fixture(params=["database", "tracks"])
def matches(request, tiny_ring, model):
    """The matches of the ring, which were not read yet."""
    of_database = request.param == "database"
    found = (
        open_database(tiny_ring / "database.db", model.images.names) if of_database else TrackMatches(model)
    )
    with closing(found):
        yield found


def part_of(model, chosen):
    """Return some of a model's images as a model of their own."""
    copy = pycolmap.Reconstruction(model.reconstruction)
    for k in set(range(model.images.num_images)) - set(chosen):
        copy.deregister_frame(int(model.images.frames.ids[model.images.frame_of[k]]))
    return read_model(copy)


def columns(batches):
    """Return what batches have, joined: matches per pair instead of offsets."""
    found = list(batches)
    names = [field.name for field in dataclasses.fields(found[0]) if field.name != "offsets"]
    joined = {name: np.concatenate([getattr(batch, name) for batch in found]) for name in names}
    return joined | {"counts": np.concatenate([np.diff(batch.offsets) for batch in found])}


def pairs_in(found, kept):
    """Return the columns of the pairs that are kept."""
    rows = np.repeat(kept, found["counts"])
    return {name: values[kept if len(values) == len(kept) else rows] for name, values in found.items()}


def assert_same_bits(found, expected):
    assert found.keys() <= expected.keys()
    for name, values in found.items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


@pytest.mark.parametrize("reading", READINGS.values(), ids=READINGS)
def test_neither_memory_nor_the_order_of_reading_changes_a_bit(matches, model, reading):
    expected = columns(matches.at(model.images).batches())
    enough = expected["counts"] >= np.median(expected["counts"])
    least = int(expected["counts"][enough].min())
    without, others = expected["pairs"][::3, ::-1], np.arange(len(enough)) % 3 > 0
    few = np.isin(expected["pairs"], np.arange(4)).all(axis=1)
    labels = np.arange(model.images.num_images) % 3 - 1
    ends = labels[expected["pairs"]]
    asked = {
        "all": (lambda view: view.batches(), np.ones_like(enough)),
        "thick": (lambda view: view.batches(least), enough),
        "others": (lambda view: view.batches(without=without), others),
        "links": (lambda view: view.links(), np.ones_like(enough)),
        "thick links": (lambda view: view.links(least, others), enough & others),
        "consumed": (lambda view: view.links(consume=True), np.ones_like(enough)),
        "few": (lambda view: view.links(chosen=few), few),
        "between": (lambda view: view.between(labels), (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])),
    }
    rng = np.random.default_rng(0)
    view = matches.at(model.images, reading=reading)
    for name in rng.permutation(list(asked) * 2).tolist():
        ask, kept = asked[name]
        assert kept.sum() > 0
        assert_same_bits(columns(ask(view)), pairs_in(expected, kept))


def test_what_is_known_before_any_match_is_read_bounds_what_is_read(matches, model):
    view = matches.at(model.images)
    found = columns(view.batches())
    np.testing.assert_array_equal(matches.pairs, found["pairs"])
    assert (matches.num_matches >= found["counts"]).all()
    assert (view.num_pairs, view.num_matches) == (len(matches.pairs), matches.num_matches.sum())
    sizes = [len(view.keypoints(k)) for k in range(model.images.num_images)]
    assert sizes == matches.num_keypoints.tolist() == view.num_keypoints.tolist()
    assert matches.total_keypoints == sum(sizes)
    assert matches.names == model.images.names


def test_progress_ends_where_all_pairs_are_done(matches, model):
    view = matches.at(model.images, reading=Reading(batch=100))
    told = {"batches": [], "links": []}
    list(view.batches(advance=lambda *done: told["batches"].append(done)))
    list(view.links(advance=lambda *done: told["links"].append(done)))
    for done in told.values():
        assert done == sorted(done)
        assert done[-1] == (len(matches.pairs), len(matches.pairs))
        assert len(done) > 3


def test_a_part_of_a_part_has_the_pairs_between_its_images_and_their_bits(matches, model):
    whole = columns(matches.at(model.images).batches())
    some, fewer = [0, 2, 3, 4, 7, 9], [1, 3, 4]
    part = part_of(model, some)
    part_of_part = part_of(part, fewer)
    for own, chosen in ((part, some), (part_of_part, np.array(some)[fewer])):
        kept = np.isin(whole["pairs"], chosen).all(axis=1)
        expected = pairs_in(whole, kept)
        expected["pairs"] = np.searchsorted(chosen, expected["pairs"])
        assert 0 < kept.sum() < len(kept)
        assert_same_bits(columns(matches.at(own.images).batches()), expected)
        view = matches.at(own.images)
        np.testing.assert_array_equal(view.keypoints(1), matches.at(model.images).keypoints(chosen[1]))
        np.testing.assert_array_equal(view.num_keypoints, matches.num_keypoints[chosen])


def test_pairs_that_are_left_out_are_unmatched(matches, model):
    whole = columns(matches.at(model.images).batches())
    gone = whole["pairs"][1::4].tolist()
    names = [tuple(sorted((model.images.names[i], model.images.names[j]))) for i, j in gone]
    left_out = frozenset([*names, ("another.jpg", model.images.names[0])])
    view = matches.at(model.images, left_out)
    assert view.num_pairs == len(whole["pairs"]) - len(gone)
    assert_same_bits(columns(view.batches()), pairs_in(whole, np.arange(len(whole["pairs"])) % 4 != 1))
    assert not matches.at(part_of(model, gone[0]).images, left_out).num_pairs


def turned(model):
    frames = model.images.frames
    axis = np.linspace(0.1, 0.3, frames.centers.size).reshape(-1, 3)
    rotations = Rotation.from_rotvec(axis).as_matrix() @ frames.rotations
    return dataclasses.replace(model, images=model.images.posed(rotations, frames.centers))


def test_other_rotations_have_the_rays_of_matches_that_are_opened_for_them(tiny_ring, matches, model):
    other = turned(model)
    before = columns(matches.at(model.images).batches())
    found = columns(matches.at(other.images).batches())
    again = (
        TrackMatches(other)
        if isinstance(matches, TrackMatches)
        else open_database(tiny_ring / "database.db", other.images.names)
    )
    with closing(again):
        assert_same_bits(found, columns(again.at(other.images).batches()))
    assert_same_bits(columns(matches.at(model.images).batches()), before)
    assert not np.array_equal(found["rays_i"], before["rays_i"])


def test_parts_are_read_elsewhere_to_the_same_bits(tiny_ring, model):
    with closing(open_database(tiny_ring / "database.db", model.images.names)) as matches:
        whole = matches.at(model.images, frozenset([model.images.names[:2]]))
        expected = columns(whole.batches())
        for size in (1, 700, 10**9):
            parts = pickle.loads(pickle.dumps(whole.parts(size)))
            assert sum(part.num_pairs for part in parts) == whole.num_pairs
            found = []
            for part in parts:
                with part.open(model.images) as view:
                    found += view.batches()
            assert_same_bits(columns(found), expected)
        assert len(whole.parts(1)) == whole.num_pairs
        assert len(whole.parts(700)) > 3
        assert len(whole.parts(10**9)) == 1
    assert len(TrackMatches(model).at(model.images).parts(700)) == 0  # only this process has the model


def test_what_was_read_once_is_read_again_by_no_view(tiny_ring, model, tmp_path):
    path = shutil.copyfile(tiny_ring / "database.db", tmp_path / "database.db")
    with closing(open_database(path, model.images.names)) as matches:
        expected = columns(matches.at(model.images).batches())
        edit_database(path, "UPDATE keypoints SET data = NULL", "UPDATE two_view_geometries SET data = NULL")
        again = columns(matches.at(turned(model).images).batches())
        np.testing.assert_array_equal(
            columns(matches.at(model.images).batches())["rays_i"], expected["rays_i"]
        )
        matches.forget()
        assert len(matches.at(model.images).keypoints(0)) == 0
    assert_same_bits({name: again[name] for name in ("pairs", "keypoints", "counts")}, expected)


def test_of_wanted_pairs_no_others_are_yielded(matches, model):
    view = matches.at(model.images)
    whole, kept = columns(view.batches()), np.arange(len(view.pairs)) % 3 == 1
    wanted = view.pairs[kept][:, ::-1]  # whatever the order of their images
    for one in (view, matches.at(model.images)):  # all are kept already, and not
        assert_same_bits(columns(one.of_pairs(wanted)), pairs_in(whole, kept))


def test_consumed_links_give_back_very_many_matches_and_what_was_yielded_stays(tiny_ring, model, monkeypatch):
    with closing(open_database(tiny_ring / "database.db", model.images.names)) as matches:
        view, other = matches.at(model.images), matches.at(turned(model).images)
        (whole,) = view.links()
        monkeypatch.setattr(scene_matches, "MOST_BESIDE_TRACKS", view.num_matches - 1)
        before = whole.keypoints.copy()
        list(view.links(consume=True))
        np.testing.assert_array_equal(whole.keypoints, before)
        (again,), (shared,) = view.links(), other.links()
    for found in (again, shared):
        assert isinstance(found, KeypointMatches)
        np.testing.assert_array_equal(found.keypoints, before)
        np.testing.assert_array_equal(found.offsets, whole.offsets)


def test_a_closed_database_is_read_no_more(tiny_ring, model):
    matches = open_database(tiny_ring / "database.db", model.images.names)
    matches.forget()  # what was read when it was opened
    matches.close()
    matches.close()
    with pytest.raises(InputError, match="cannot be read"):
        list(matches.at(model.images).batches())


def test_a_keypoint_without_a_ray_has_no_match(tiny_ring, model):
    def blinkered(lens, xy):
        """The left halves of images have no rays."""
        return np.where(xy[:, :1] < 600.0, np.nan, rays_of(lens, xy))

    for matches in (TrackMatches(model), open_database(tiny_ring / "database.db", model.images.names)):
        with closing(matches):
            whole = columns(matches.at(model.images).batches())
            matches.rays, view = blinkered, matches.at(model.images)
            pixels = [view.keypoints(k)[:, 0] for k in range(model.images.num_images)]
            of_match = np.repeat(whole["pairs"], whole["counts"], axis=0)
            seen = np.array(
                [
                    pixels[i][a] >= 600.0 and pixels[j][b] >= 600.0
                    for (i, j), (a, b) in zip(of_match.tolist(), whole["keypoints"].tolist(), strict=True)
                ]
            )
            assert 0 < seen.sum() < len(seen)
            for found in (columns(view.batches()), columns(view.links())):
                for name in ("keypoints", "rays_i", "rays_j"):
                    np.testing.assert_array_equal(found.get(name, whole[name][seen]), whole[name][seen])


@pytest.mark.parametrize("directions", ["matches", "tracks"])
def test_a_run_that_keeps_nothing_of_its_matches_ends_at_the_same_bits(monkeypatch, directions):
    database = RING / "database.db" if directions == "matches" else None

    def run():
        found = sfm_shapefit.locate(RING / "sparse" / "0", database, directions=directions)
        return found.placement.locations, np.array([row.center for row in found.cameras if row.placed])

    usual, at = run(), Matches.at

    def frugal(matches, images, left_out=frozenset(), _reading=PLENTY):
        return at(matches, images, left_out, READINGS["nothing is kept"])

    monkeypatch.setattr(Matches, "at", frugal)
    for found, expected in zip(run(), usual, strict=True):
        np.testing.assert_array_equal(found, expected)
