"""The last stage: from a model with its evidence to the result, with all that the user should know of it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, hand_back_memory
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.geometry import fit_similarity_l1, mean_rotation_l1, turned_deg
from sfm_shapefit.facts.lengths import Axes, LengthFacts, length_between
from sfm_shapefit.facts.located_warnings import located_warnings
from sfm_shapefit.facts.placed import unit_of
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.rigs import refined_rigs
from sfm_shapefit.facts.warnings import rotation_suspicions, rotation_warnings
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.judgement.uncertainty import standard_deviations
from sfm_shapefit.pipeline.gauge_choice import scale_errors
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.gauge import (
    ARBITRARY,
    FEWEST_CHECKED,
    FEWEST_PRIORS,
    UselessPriorsError,
    coincide,
    prior_gauge,
)
from sfm_shapefit.placement.gauge_rule import SETS_SCALE
from sfm_shapefit.placement.prior_fit import PriorFit, compare_with_priors


def finish_model(state: ModelState, clock: Clock) -> LocateResult:
    """Return the result that all stages have led to."""
    inputs, source = state.inputs, state.source
    with clock("model"):
        keypoints = source.view.keypoints if source.has_database else None
        seed = SeededModel.of(_resize_sensors(state), state.images, state.points, keypoints)
        hand_back_memory()  # freed by the judgement; the files of a model take as much
    done = [one for one in (state.first, state.adjustment, state.bundle) if one]
    result = LocateResult(
        seed=seed,
        inputs=source.inputs,
        options=inputs.options,
        images=source.images,
        placed=state.images,
        image_names=inputs.template.image_names,
        directions=state.directions,
        placement=state.judged,
        kept=state.kept,
        support=state.support,
        gauge=state.gauge,
        adjusted=state.bundle,
        adjustment=state.adjustment,
        turned_deg=state.turned_deg,
        timings_s=clock.seconds,
        warnings=(),
        fixed=inputs.fixed,
        distances=inputs.distances,
        prior_fit=_compare_with_priors(state),
        evidence=state.evidence,
        intrinsics=state.intrinsics,
        rigs=refined_rigs(inputs.images, state.images, state.freedom, done),
        control_points=state.control,
        scale_bars=state.bars.rows() if state.bars else (),
        lengths=usual_length(state),
        suspicions=state.reasons,
    )
    result = replace(result, warnings=tuple(_warnings(result, state)))
    return result if inputs.rough_rad is None else _compare_with_rough(result, state, inputs.rough_rad)


def _resize_sensors(state: ModelState) -> Template:
    """Return the template with sensors that are no cameras in the scale of the output, if that is another."""
    template, given = state.inputs.template, state.inputs.images
    posed = state.images.is_posed & given.is_posed
    old, new = given.centers[posed], state.images.centers[posed]
    keeps = state.gauge.scale in ("input", "rig", "fixed") or not template.has_open_sensors
    if keeps or len(old) < FEWEST_PRIORS or coincide(old):
        return template
    return template.resized(fit_similarity_l1(old, new).scale)


def _compare_with_priors(state: ModelState) -> PriorFit | None:
    """Return how well position priors fit the delivered images; None without any that serve.

    Where something else set origin and axes, they are compared after a fit, if enough check one another.
    """
    priors, pairs, gauge, judged = state.inputs.known.priors, state.directions, state.gauge, state.judged
    if priors is None:
        return None
    centers, scale = state.images.centers, gauge.similarity.scale
    directions = pairs.directions if gauge.axes is None else pairs.directions @ gauge.axes.T
    if not gauge.has_priors:
        posed = np.flatnonzero(np.isfinite(centers).all(axis=1))
        own = priors.of(posed)
        if len(own) < FEWEST_CHECKED:
            return None
        try:
            onto = prior_gauge(centers[posed], own)
        except UselessPriorsError:
            return None
        centers, scale = onto.apply(centers), scale * onto.similarity.scale
        directions = directions if onto.axes is None else directions @ onto.axes.T
    sigmas, axis_sigmas = np.full(len(centers), np.nan), standard_deviations(judged.covariances)
    sigmas[judged.cameras] = scale * axis_sigmas.max(axis=1)
    return compare_with_priors(centers, sigmas, priors, pairs.pairs, directions)


def _warnings(result: LocateResult, state: ModelState) -> Iterator[str]:
    """Yield what the user should know of a finished piece beyond the tables: what speaks against it first."""
    images, gauge = result.placed, result.gauge
    posed = np.flatnonzero(images.is_posed)
    of_scale = list(state.gauge_rule.check(gauge, posed, images.centers[posed]))
    if result.options.gauge.scale == "unit" and gauge.scale != "unit":
        of_scale.append(f"the scale unit was not used, but that of {SETS_SCALE[gauge.scale]}")
    yield from located_warnings(result, of_scale)
    yield from state.warnings


def _compare_with_rough(result: LocateResult, state: ModelState, sigma_rad: float) -> LocateResult:
    """Return a piece with how far images were turned and moved from where they roughly were."""
    given, images, sigma_deg = state.inputs.images, result.images, float(np.degrees(sigma_rad))
    posed = np.isfinite(result.placed.centers).all(axis=1)
    common = mean_rotation_l1(given.rotations[posed].transpose(0, 2, 1) @ images.rotations[posed])
    turned = np.where(posed, turned_deg(given.rotations @ common, images.rotations), np.nan)
    result = replace(result, turned_deg=turned, moved=_moved(given.centers, result.placed.centers))
    if result.placement.piece:
        return result
    suspicions = (*result.suspicions, *rotation_suspicions(turned, sigma_deg))
    wrong = rotation_warnings(turned, given.names, sigma_deg)
    return replace(result, suspicions=suspicions, warnings=(*wrong, *result.warnings))


def _moved(given: FloatArray, placed: FloatArray) -> FloatArray | None:
    """Return how far centers (n, 3) are from the given ones; None if these are no places."""
    common = np.isfinite(placed).all(axis=1) & np.isfinite(given).all(axis=1)
    if coincide(given[common]):
        return None
    motion = fit_similarity_l1(given[common], placed[common])
    return np.asarray(np.linalg.norm(motion.apply(given) - placed, axis=1))


def usual_length(state: ModelState) -> LengthFacts | None:
    """Return how well a length between points of a finished model is known; None where it is not known."""
    gauge = state.gauge
    axes = Axes(
        unit=unit_of(gauge),
        has_scale=gauge.scale not in ARBITRARY,
        has_up=gauge.datum is not None or state.inputs.known.gravity is not None,
    )
    return length_between(state.images, state.points, state.estimate, scale_errors(state), axes)
