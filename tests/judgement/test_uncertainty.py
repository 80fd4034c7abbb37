"""Standard deviations, gauges and leverages against dense linear algebra and against scatter."""

import numpy as np
import pytest

import sfm_shapefit
from harness.graphs import laplacian_matrix
from sfm_shapefit.base.geometry import normalized, tangent_bases
from sfm_shapefit.judgement.correlated_errors import sample_direction_errors
from sfm_shapefit.judgement.uncertainty import propagate
from sfm_shapefit.pipeline import measure
from sfm_shapefit.scene.matches import MatchBatch
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.splitting.linear import Resources
from sfm_shapefit.synthetic import SceneOptions, box_graph_problem, make_scene
from tests.scenes import RING

SIGMA = 0.01  # rad, per axis


def isotropic(count, d=3, sigma=SIGMA):
    return np.tile(np.eye(d) / sigma**2, (count, 1, 1))


def dense_covariance(t, edges, information):
    """The pseudo-inverse of H: centroid and scale of all nodes held fixed."""
    baselines = differences(t, edges)
    u = normalized(baselines)
    across = np.eye(t.shape[1]) - u[:, :, None] * u[:, None, :]
    blocks = across @ information @ across / np.sum(baselines**2, axis=1)[:, None, None]
    hessian = laplacian_matrix(len(t), edges, blocks).toarray()
    return np.linalg.pinv(hessian, rcond=1e-10, hermitian=True)


@pytest.mark.parametrize("d", [2, 3])
def test_standard_deviations_are_those_of_the_dense_inverse(d):
    rng = np.random.default_rng(d)
    t = rng.standard_normal((30, d))
    edges = np.array([(i, j) for i in range(30) for j in range(i + 1, 30) if rng.random() < 0.4])
    roots = rng.standard_normal((len(edges), d, d)) / SIGMA
    information = roots @ roots.transpose(0, 2, 1)
    found = propagate(t, edges, information)
    expected = np.sqrt(np.diag(dense_covariance(t, edges, information))).reshape(t.shape)
    assert found.gauge.all()
    np.testing.assert_allclose(found.sigmas, expected, rtol=1e-6)  # the ridge changes 1e-12 of each block


def test_leverages_add_up_to_the_number_of_unknowns_and_are_one_where_nothing_checks_a_direction():
    problem = box_graph_problem(60, 12.0, seed=1)
    found = propagate(problem.locations, problem.edges, isotropic(len(problem.edges)))
    assert found.leverages.sum() == pytest.approx((3 * 60 - 4) / 2, rel=1e-6)
    assert found.leverages.min() > 0.0
    assert found.leverages.max() < 1.0
    t = np.random.default_rng(2).standard_normal((3, 2))
    found = propagate(t, np.array([(0, 1), (1, 2), (0, 2)]), isotropic(3, 2))  # 3 equations, 6 - 3 unknowns
    np.testing.assert_allclose(found.leverages, 1.0, rtol=1e-6)


def test_a_camera_that_hardly_anything_holds_does_not_decide_the_gauge_of_the_others():
    problem = box_graph_problem(40, 12.0, seed=3)
    information = isotropic(len(problem.edges))
    information[(problem.edges == 7).any(axis=1)] *= 1e-8
    found = propagate(problem.locations, problem.edges, information)
    others = np.delete(np.arange(40), 7)
    assert np.flatnonzero(~found.gauge).tolist() == [7]
    assert found.sigmas[7].min() > 1.0
    undisturbed = propagate(problem.locations, problem.edges, isotropic(len(problem.edges)))
    # The others lose the pairs of camera 7, 3 % of all; infected, they would be off by its 1e2 or more.
    np.testing.assert_allclose(found.sigmas[others], undisturbed.sigmas[others], rtol=1.0)


def test_points_are_judged_with_the_cameras_but_do_not_hold_the_gauge():
    problem = box_graph_problem(40, 12.0, seed=4)
    given = problem.locations, problem.edges, isotropic(len(problem.edges))
    found = propagate(*given, num_cameras=25)
    assert found.gauge.tolist() == [True] * 25 + [False] * 15
    assert np.isfinite(found.sigmas).all()
    assert (
        propagate(*given, resources=Resources(memory_bytes=1000)) is None
    )  # a factor beyond the limit is not tried


def test_independent_samples_scatter_like_the_inverse():
    problem = box_graph_problem(40, 12.0, seed=6)
    bases = tangent_bases(normalized(differences(problem.locations, problem.edges)))
    draws = SIGMA * np.random.default_rng(6).standard_normal((len(problem.edges), 2000, 2))
    information = isotropic(len(problem.edges))
    sampled = propagate(
        problem.locations, problem.edges, information, None, [draws @ bases.transpose(0, 2, 1)]
    )
    exact = propagate(problem.locations, problem.edges, information)
    samples = draws @ bases.transpose(0, 2, 1)
    in_parts = propagate(
        problem.locations, problem.edges, information, None, [samples[:9], samples[:0], samples[9:]]
    )
    np.testing.assert_allclose(in_parts.sigmas, sampled.sigmas, rtol=1e-12)
    np.testing.assert_allclose(sampled.sigmas, exact.sigmas, rtol=0.065)  # 1.6 % at one sigma; four of those


def rays_of(scene, pixel_noise_px, rng):
    """The two rays of every match of a scene whose keypoints get new noise."""
    inverse = np.linalg.inv(scene.calibration)
    rays = []
    for xy, rotation in zip(scene.keypoints, scene.rotations, strict=True):
        noisy = xy + pixel_noise_px * rng.standard_normal(xy.shape)
        rays.append(normalized(np.column_stack([noisy, np.ones(len(xy))]) @ inverse.T @ rotation))
    offsets, matches = scene.match_offsets, scene.matches
    own = [matches[offsets[e] : offsets[e + 1]] for e in range(scene.num_pairs)]
    first = np.concatenate([rays[i][m[:, 0]] for (i, _), m in zip(scene.pairs, own, strict=True)])
    second = np.concatenate([rays[j][m[:, 1]] for (_, j), m in zip(scene.pairs, own, strict=True)])
    return first, second


def test_sampled_errors_of_pairs_that_share_keypoints_are_correlated_as_real_ones():
    scene = make_scene(SceneOptions(shape="cloud", num_images=6, num_points=300, pixel_noise_px=1e-9))
    v = normalized(differences(scene.centers, scene.pairs))
    bases = tangent_bases(v)
    pixel = 1.0 / scene.options.focal_length_px
    first, second = rays_of(scene, 0.0, np.random.default_rng(0))
    pair_of = np.repeat(np.arange(scene.num_pairs), np.diff(scene.match_offsets))

    def information(a, b):
        normals = np.cross(a, b) / pixel
        square = np.sum(np.cross(a, v[pair_of]) ** 2 + np.cross(b, v[pair_of]) ** 2, axis=1)
        outer = normals[:, :, None] * normals[:, None, :] / square[:, None, None]
        sums = np.zeros((scene.num_pairs, 3, 3))
        np.add.at(sums, pair_of, outer)
        return sums

    covariances = np.linalg.inv(bases.transpose(0, 2, 1) @ information(first, second) @ bases)  # of 1 px
    matches = MatchBatch(
        pairs=scene.pairs,
        offsets=scene.match_offsets,
        keypoints=scene.matches,
        rays_i=first,
        rays_j=second,
        pixel_angles=np.full(scene.num_pairs, pixel),
    )
    sampled = sample_direction_errors(matches, v, covariances, np.ones(scene.num_pairs), 2.0)
    sampled = sampled.transpose(1, 0, 2).reshape(len(sampled[0]), -1)

    real = []
    for seed in range(400):  # least squares directions of freshly drawn keypoints, 0.1 px: still linear
        a, b = rays_of(scene, 0.1, np.random.default_rng(seed))
        smallest = np.linalg.eigh(information(a, b))[1][:, :, 0]
        smallest *= np.sign(np.sum(smallest * v, axis=1))[:, None]
        real.append(10.0 * np.einsum("edk,ed->ek", bases, smallest).ravel())
    scale = np.sqrt(np.repeat(np.trace(covariances, axis1=1, axis2=2) / 2, 2))
    predicted = (sampled / scale).T @ (sampled / scale) / len(sampled)
    measured = (np.array(real) / scale).T @ (np.array(real) / scale) / len(real)
    # Away from the image's center a pixel is a smaller angle, in a real scene a smaller noise.
    measured /= np.mean(np.diag(measured))
    assert np.mean(np.diag(predicted)) == pytest.approx(1.0, abs=0.05)
    # Entries scatter by 0.10 (96 samples) and 0.05 (400 draws); independent pairs have 0 off the blocks.
    between = np.kron(np.eye(scene.num_pairs), np.ones((2, 2))) == 0
    assert np.corrcoef(predicted[between], measured[between])[0, 1] > 0.8
    assert np.polyfit(measured[between], predicted[between], 1)[0] == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("limit", ["_MAX_SAMPLED_PAIRS", "_MOST_PAIRS"])
def test_independent_pairs_count_what_their_tracks_say_once(limit, monkeypatch):
    def sizes():
        found = sfm_shapefit.locate(RING / "sparse" / "0", adjust="none")
        return np.linalg.norm([row.sigma for row in found.cameras if row.placed], axis=1)

    sampled = sizes()
    monkeypatch.setattr(measure, limit, 0)
    counted = sizes()
    assert 0.75 < np.median(counted / sampled) < 1.25
    assert (counted != sampled).all()
