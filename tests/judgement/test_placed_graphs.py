"""The verdict of bare graphs: where directions alone cannot tell, `place` says so and names the cameras."""

import numpy as np
import pytest

from harness.graphs import relative_error
from sfm_shapefit import ViewGraph, place
from sfm_shapefit.judgement.few_ties import barely_held, find_few_ties
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.placement.second_configuration import Found, find_rival
from sfm_shapefit.synthetic import random_graph_problem
from tests.program import run

NOISE_RAD = 0.003


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def graph_of(centers, pairs, others, rng):
    """Return the view graph of directions from `others` (m, 3) to the first camera of each pair, with noise."""
    directions = unit(centers[pairs[:, 0]] - others)
    return ViewGraph(len(centers), pairs, unit(directions + NOISE_RAD * rng.normal(size=others.shape)))


def corridor(share, seed, num_cameras=80, period=8.0, reach=10):
    """Return a bent corridor whose segments repeat: a share of the second cameras is seen a period off."""
    rng, along = np.random.default_rng(seed), np.arange(num_cameras) / 40.0
    centers = 40.0 * np.column_stack([np.sin(along), np.cos(along), 0.0 * along])
    centers += 0.3 * rng.normal(size=centers.shape)
    pairs = np.array([(i, j) for i in range(num_cameras) for j in range(i + 1, min(i + reach, num_cameras))])
    tangents = np.column_stack([np.cos(along), -np.sin(along), 0.0 * along])[pairs[:, 1]]
    shifts = rng.choice([-period, period], len(pairs)) * (rng.random(len(pairs)) < share)
    return graph_of(centers, pairs, centers[pairs[:, 1]] + shifts[:, None] * tangents, rng), centers


def four_sides(share, seed, num_cameras=60):
    """Return a ring about a scene of four equal sides: a share of the second cameras is seen on the first's."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * np.pi * (np.arange(num_cameras) + rng.uniform(-0.3, 0.3, num_cameras)) / num_cameras
    centers = np.column_stack(
        [10.0 * np.cos(angles), 10.0 * np.sin(angles), 2.0 * rng.normal(size=num_cameras)]
    )
    pairs = np.column_stack(np.triu_indices(num_cameras, 1))
    apart = pairs[:, 1] - pairs[:, 0]
    near = np.minimum(apart, num_cameras - apart) <= num_cameras // 3
    pairs = pairs[near & (rng.random(len(pairs)) < 0.6)]
    sides = np.arange(num_cameras) * 4 // num_cameras
    quarters = np.where(rng.random(len(pairs)) < share, sides[pairs[:, 0]] - sides[pairs[:, 1]], 0)
    flat = centers[pairs[:, 1], :2] @ np.array([1.0, 1.0j]) * 1j**quarters
    seen = np.column_stack([flat.real, flat.imag, centers[pairs[:, 1], 2]])
    return graph_of(centers, pairs, seen, rng), centers
