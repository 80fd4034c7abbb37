"""What the whole pipeline may not notice: how images are called, and how the world is turned.

That ids, and the order in which anything is listed, do not matter is in tests/abuse.
"""

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.geometry import fit_similarity
from tests.models import centers_of, posed
from tests.problems import turn
from tests.scenes import COURTYARD, copied, edit_database

MODEL, DATABASE = COURTYARD / "sparse" / "0", COURTYARD / "database.db"
ALONE = {"scale": "unit", "adjust": "none"}  # an adjustment ends at a tolerance, elsewhere for another order


@pytest.fixture(scope="module")
def usual():
    return sfm_shapefit.locate(MODEL, DATABASE, **ALONE)


def trusts(found):
    return np.array([row.trust for row in found.cameras])


def test_a_turned_world_turns_the_answer(usual):
    axes = turn([0.4, -1.1, 0.7], 70.0)
    model = posed(MODEL, lambda _name, rotation, center: (rotation @ axes.T, axes @ center))
    found = sfm_shapefit.locate(model, DATABASE, **ALONE)
    np.testing.assert_allclose(
        centers_of(found.reconstruction), centers_of(usual.reconstruction) @ axes.T, atol=1e-7
    )
    np.testing.assert_allclose(trusts(found), trusts(usual), atol=1e-4)
    assert [row.verdict for row in found.pairs] == [row.verdict for row in usual.pairs]


@pytest.fixture(scope="module")
def renamed(tmp_path_factory):
    """Other names of the images, by id, and a database and a model that have them."""
    scene = copied(COURTYARD, tmp_path_factory.mktemp("renamed"))
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    ids = sorted(model.images)
    order = np.random.default_rng(0).permutation(len(ids))
    names = {image_id: f"other{place:02d}.png" for image_id, place in zip(ids, order, strict=True)}
    for image_id, name in names.items():
        model.image(image_id).name = name
        change = f"UPDATE images SET name = '{name}' WHERE image_id = {image_id}"
        edit_database(scene / "database.db", change)
    return names, model, scene / "database.db"


def test_other_names_in_another_order_change_nothing_else(usual, renamed):
    names, model, database = renamed
    found = sfm_shapefit.locate(model, database, **ALONE)
    # Which draws fall on which matches goes by the order of names; positions are known to 1e-3.
    np.testing.assert_allclose(centers_of(found.reconstruction), centers_of(usual.reconstruction), atol=1e-4)
    by_name = {row.name: row for row in found.cameras}
    for row, image_id in zip(usual.cameras, sorted(names), strict=True):
        assert by_name[names[image_id]].trust == pytest.approx(row.trust, abs=1e-2)
    verdicts = {frozenset((row.name1, row.name2)): row.verdict for row in found.pairs}
    new = {row.name: names[image_id] for row, image_id in zip(usual.cameras, sorted(names), strict=True)}
    for row in usual.pairs:
        assert verdicts[frozenset((new[row.name1], new[row.name2]))] == row.verdict


def test_other_names_change_nothing_of_a_map_but_its_world(renamed):
    names, _, database = renamed
    plain, other = (
        sfm_shapefit.map_database(path, adjust="none", sequence="none") for path in (DATABASE, database)
    )
    first, second = (centers_of(found.models[0].reconstruction) for found in (plain, other))
    assert len(first) == len(second) == len(names)
    fit = fit_similarity(second, first)
    np.testing.assert_allclose(fit.apply(second), first, atol=1e-4 * np.ptp(first))
