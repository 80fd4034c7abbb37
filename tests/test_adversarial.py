"""Inputs made to mislead: each ends in a stated reason or in low trust, never in NaN or a wild camera.

Twelve cameras with a direction for every pair, one of them, or one pair, changed for the worse.
"""

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit import TrustOptions
from sfm_shapefit.base.geometry import fit_similarity_l1, normalized
from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.warnings import graph_warnings, quality_warnings
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.grade import largest_sigmas, uncertain_cameras
from sfm_shapefit.placement.diagnosis import diagnose
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.solver.program import differences
from tests.models import turned
from tests.problems import all_pairs
from tests.scenes import RING

N = 12
BAD = N - 1
MIN_TRUST = TrustOptions().min_trust
CENTERS = np.random.default_rng(1).standard_normal((N, 3))
ALL = all_pairs(N)
OF_BAD = [k for k, (_, j) in enumerate(ALL) if j == BAD]
OTHERS = [pair for pair in ALL if BAD not in pair]
NOISE = [0.0, 1e-3]  # rad per axis


def measured(t, edges, noise):
    v = normalized(differences(t, np.array(edges)))
    return normalized(v + noise * np.random.default_rng(0).standard_normal(v.shape))


def errors_of(placement: Placement, t):
    """The errors of all cameras, aligned on those that are not the bad one."""
    good = placement.cameras != BAD
    true = t[placement.cameras]
    aligned = fit_similarity_l1(placement.locations[good], true[good], rotate=False)
    return np.linalg.norm(aligned.apply(placement.locations) - true, axis=1)[good]


def assert_only_the_bad_camera_is_distrusted(placement, t, noise):
    assert np.isfinite(placement.locations).all()
    trust = placement.assessment.trust
    assert np.isfinite(trust).all()
    assert placement.cameras[trust < MIN_TRUST].tolist() == [BAD]
    assert placement.assessment.reasons[-1]
    loose = f"1 camera is uncertain by more than 5% of the extent, {BAD}; see sigma and trust in cameras.csv"
    assert loose in quality_warnings(placement)
    (distrusted,) = set(graph_warnings(placement)) - set(quality_warnings(placement))
    assert f"1 of {N} nodes have a trust below {MIN_TRUST}, above all {BAD} (" in distrusted
    # Eleven cameras of distance about 2 with ten directions each: an error of about noise * 2 / sqrt(10).
    assert np.max(errors_of(placement, t)) < 1e-6 + 10.0 * noise


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("joined", [False, True], ids=["apart", "joined"])
def test_twins_at_one_center_are_placed_at_one_center(noise, joined):
    """What a pair of twins measures is noise; it is that of no baseline at all."""
    t = CENTERS.copy()
    t[BAD] = t[BAD - 1]
    edges = [pair for pair in ALL if pair != (BAD - 1, BAD)]
    v = measured(t, edges, noise)
    if joined:
        edges, v = [*edges, (BAD - 1, BAD)], np.concatenate([v, [[0.0, 0.0, 1.0]]])
    placement = place(ViewGraph(N, edges, v))
    assert np.isfinite(placement.locations).all()
    assert np.isfinite(placement.assessment.trust).all()
    assert np.isfinite(placement.assessment.residuals_deg).all()
    assert np.max(errors_of(placement, t)) < 1e-6 + 10.0 * noise
    scale = np.median(np.linalg.norm(placement.locations, axis=1))
    assert np.linalg.norm(placement.locations[BAD] - placement.locations[BAD - 1]) < scale * (
        1e-6 + 10.0 * noise
    )


@pytest.mark.parametrize("noise", NOISE)
def test_a_camera_of_wrong_pairs_only_is_not_trusted(noise):
    v = measured(CENTERS, ALL, noise)
    v[OF_BAD] = normalized(np.random.default_rng(12).standard_normal((len(OF_BAD), 3)))
    graph = ViewGraph(N, ALL, v)
    assert_only_the_bad_camera_is_distrusted(place(graph), CENTERS, noise)
    assert [camera.name for camera in diagnose(graph).weak] == [str(BAD)]


@pytest.mark.parametrize("noise", NOISE)
def test_a_camera_on_the_line_of_its_two_neighbors_is_not_trusted(noise):
    """Rigid by its graph, free to slide by its geometry; without noise its residuals are 0 wherever it is."""
    t = CENTERS.copy()
    t[BAD] = 2.0 * t[1] - t[0]
    edges = [*OTHERS, (0, BAD), (1, BAD)]
    placement = place(ViewGraph(N, edges, measured(t, edges, noise)))
    assert_only_the_bad_camera_is_distrusted(placement, t, noise)


@pytest.mark.parametrize("noise", NOISE)
def test_cameras_on_one_line_are_none_of_them_trusted(noise):
    t = CENTERS * [0.0, 0.0, 1.0]
    placement = place(ViewGraph(N, ALL, measured(t, ALL, noise)))
    assert np.isfinite(placement.locations).all()
    assert (placement.assessment.trust < MIN_TRUST).all()
    uncertain = len(uncertain_cameras(placement))
    assert uncertain > 1
    worst = placement.cameras[np.argmax(largest_sigmas(placement))]
    loose = (
        f"{uncertain} cameras are uncertain by more than 5% of the extent, above all {worst}; see sigma and "
    )
    assert any(warning.startswith(loose) for warning in quality_warnings(placement))


def test_a_camera_whose_pairs_all_contradict_its_rotation_is_not_placed():
    model = turned(RING / "sparse" / "0", ["0003.jpg"], np.diag([-1.0, 1.0, -1.0]))  # looks backwards
    found = sfm_shapefit.locate(model, RING / "database.db")
    (row,) = [row for row in found.cameras if not row.placed]
    assert row.name == "0003.jpg"
    assert "contradict the rotations" in row.reason or "not trusted" in row.reason
    errors = sfm_shapefit.evaluate(found.reconstruction, RING / "sparse" / "0").position
    assert errors.max < 2e-6 * 5.0  # exact data, keypoints stored as float32
