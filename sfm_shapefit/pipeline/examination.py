"""Ask for evidence that the fit did not use: of our own models, and of any that is looked at."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.lens_doubts import excess
from sfm_shapefit.adjustment.missing_distortion import find_missing_distortion
from sfm_shapefit.adjustment.open_shape import estimate_open_shape
from sfm_shapefit.adjustment.sources import Links
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.executors import nobody
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.intrinsics import calibrated_focals
from sfm_shapefit.files.colmap.lenses import is_bogus
from sfm_shapefit.files.colmap.points import ModelKeypoints
from sfm_shapefit.judgement.duplicates import find_split_duplicates
from sfm_shapefit.judgement.evidence import ModelEvidence, OddImages, OpenShape
from sfm_shapefit.judgement.lens_questions import ask_points
from sfm_shapefit.judgement.lenses import find_changed_lenses
from sfm_shapefit.judgement.limits import CHANCE_SHARE, SMALLEST_SHAPE
from sfm_shapefit.judgement.pair_fits import PairFits, fit_pairs
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.judgement.resolutions import find_outside
from sfm_shapefit.judgement.rig_offsets import find_contradicted_rigs
from sfm_shapefit.judgement.seams import GroupApart, find_cuts, find_seams
from sfm_shapefit.judgement.tied_groups import rigid_strip, tie_images
from sfm_shapefit.judgement.trust import LOW_TRUST
from sfm_shapefit.judgement.witnesses import are_confirmed
from sfm_shapefit.pipeline.doubts import ask_rotations
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Origin
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.links import ObservedTracks

_MISSES_DISTORTION = (
    "a lens without distortion, though its points show one: with it, cameras move by {} % of their usual "
    "distance from the middle; use --camera-model SIMPLE_RADIAL, or COLMAP's --ImageReader.camera_model"
)
_OPEN = 1e100  # squared units; larger covariances overflow, and mean that nothing holds a camera


def gather_evidence(
    source: MatchSource, fits: PairFits | None, structure: Structure, threads: int
) -> ModelEvidence:
    """Return the evidence against a model that its fit did not use.

    Images and `fits`, those of all pairs, are at the rotations of the model; None if no pair has a direction.
    """
    images = structure.images
    bogus = np.array([is_bogus(lens) for lens in images.lenses], dtype=np.bool_)
    lenses, fields, odd = ask_points(structure, bogus, threads)
    if fits is None:
        return ModelEvidence(lenses=lenses, odd=odd, fields=fields)
    odd = (*odd, *find_contradicted_rigs(images, fits.directions))
    if source.has_database and structure.has_keypoints_of(source.view):
        duplicates = find_split_duplicates(structure, fits.directions, source.view, threads)
        odd = (*odd, *duplicates, *find_outside(structure))
    tied, untied = tie_images(source.view, fits, structure, source.fixed, source.tied, threads)
    cuts, seams = find_cuts(*fits.sides, tied), tuple[GroupApart, ...]()
    if cuts:  # which are seams by the rotations that pairs across have by themselves
        across = np.concatenate([cut.contradicting for cut in cuts])
        seams = find_seams(cuts, ask_rotations(source, across, threads), source.images)
    apart = frozenset(name for seam in seams if not seam.is_rival for name in seam.images)
    contradictions, places = fits.contradicted(images), fits.other_places(images.names)
    asked_of = [*contradictions, *(() if source.has_database else (one.image for one in places))]
    # Own tracks hold no second place of who fits the first.
    confirmed = ask_pixels(source, structure, asked_of)
    num_unasked = int(np.sum(source.view.num_keypoints == 0)) if source.inputs.is_made else 0
    return ModelEvidence(
        lenses=lenses,
        odd=odd,
        places=tuple(one for one in places if source.has_database or one.image not in confirmed),
        seams=seams,
        contradicted=tuple(name for name in contradictions if name not in confirmed),
        contradictions=contradictions,
        untied=tuple(one for one in untied if 2 * len(apart.intersection(one.images)) < len(one.images)),
        num_held=int(np.bincount(tied[images.is_posed]).max(initial=0)) + num_unasked,
        sides=(int(fits.agrees.sum()), int(fits.contradicts.sum())),
        fields=fields,
    )


def question(state: ModelState, clock: Clock) -> ModelEvidence:
    """Return the evidence against a model of ours: by its pairs, the points, and those who were left out."""
    placement, source, images = state.placement, state.source, state.images
    centers = np.full((images.num_images, 3), np.nan)
    centers[placement.cameras[state.kept]] = placement.locations[state.kept]
    fits = fit_pairs(centers, state.directions)
    points, among = state.points, images.is_posed
    if placement.piece == 0 and source.has_database:
        images = with_left_out(state)
    if (others := images.is_posed & ~among).any():
        points = points.seen_by(others, source.view.num_keypoints, source.view.links())
    pictures = ModelKeypoints(images, source.view.keypoints, source.view.num_keypoints)
    structure = Structure(points, images, pictures, among, None if source.fixed is None else ~source.fixed)
    source = replace(source, tied=_tied_by_priors(state, images))
    found, gauge = gather_evidence(source, fits, structure, clock.threads), state.gauge
    places = (one.moved(gauge.similarity.scale, gauge.axes) for one in found.places)
    inputs, found = state.inputs, replace(found, places=tuple(places))
    held = {"rotations_held": inputs.knows_rotations, "shape_held": _is_shape_held(state)}
    return with_lens_evidence(found, source, structure, clock.threads, **held)


def confirm_by_pixels(state: ModelState) -> BoolArray:
    """Return the doubted images (i,) that stand where their pixels see the points of the others."""
    source, judged, support = state.source, state.judged, state.support
    doubted = np.zeros(source.images.num_images, dtype=np.bool_)
    doubted[judged.cameras] = (judged.assessment.trust < LOW_TRUST) | ~state.kept
    doubted |= support.num_seen >= 0
    doubted &= ~support.unsupported  # a wrong lens or so, of which its own points know more
    if not (doubted.any() and source.has_database):
        return np.zeros_like(doubted)
    images = with_left_out(state)
    pictures = ModelKeypoints(images, source.view.keypoints, source.view.num_keypoints)
    names = images.names_of(np.flatnonzero(doubted))
    return images.are_named(ask_pixels(source, Structure(state.points, images, pictures), names))


def with_lens_evidence(
    evidence: ModelEvidence,
    source: MatchSource,
    structure: Structure,
    threads: int,
    *,
    rotations_held: bool = False,
    shape_held: bool = False,
) -> ModelEvidence:
    """Return the evidence with lenses that miss a distortion, and focal lengths far from those known.

    These were given, or a database has them. Where the shape is held, no distortion is asked for; images that
    are odd already have no part in it, as their errors would be taken for one.
    """
    images, matches, among = structure.images, source.matches, structure.among
    if among is not None:
        images = images.part(np.flatnonzero(images.is_posed & among))
    known_px = calibrated_focals(matches.file, images) if isinstance(matches, DatabaseMatches) else {}
    lenses = enumerate(images.lenses)
    known_px |= {k: one.as_given().focal_px for k, one in lenses if one.origin is Origin.CALIBRATION}
    odd = [*evidence.odd, *find_changed_lenses(images, known_px)]
    if not shape_held:
        asked = ~structure.images.are_named([name for one in odd for name in one.images])
        if among is not None:
            asked &= among
        bent, share = find_missing_distortion(
            structure, asked, rotations_held=rotations_held, threads=threads
        )
        if len(bent):
            shares, names = np.full(len(bent), 100.0 * share), structure.images.names_of(bent)
            odd.append(OddImages.of_values(Kind.LENS, names, shares, _MISSES_DISTORTION))
    return replace(evidence, odd=tuple(odd))


def with_left_out(state: ModelState) -> Images:
    """Return the delivered images, and where they are placed those that were left out."""
    placed_centers, now = state.placed().frames.centers, state.images.frames.centers
    common = np.isfinite(placed_centers).all(axis=1) & np.isfinite(now).all(axis=1)
    motion = fit_similarity(placed_centers[common], now[common])
    placed = np.where(np.isfinite(now), now, motion.apply(placed_centers))
    return state.images.posed(state.images.frames.rotations, placed)


def _tied_by_priors(state: ModelState, images: Images) -> IntArray | None:
    """Return pairs (k, 2) of images that priors tie: those whose own is as certain as a camera should be."""
    if state.held is None:
        return None
    centers = images.centers[images.is_posed]
    most = CHANCE_SHARE * float(np.linalg.norm(np.ptp(centers, axis=0)))
    frames = state.held.indices[state.held.sigmas() <= most]
    return rigid_strip(images, np.isin(images.frame_of, frames) & images.is_posed)


def _is_shape_held(state: ModelState) -> bool:
    """Return whether priors or fixed images hold the shape, whatever the points and lenses are."""
    return state.held is not None or bool(state.inputs.fixed.any())


def shape_of(state: ModelState, threads: int) -> OpenShape | None:
    """Return what own tracks leave open of the delivered images, where nothing else holds their shape."""
    inputs, images = state.inputs, state.images
    if state.source.has_database or _is_shape_held(state):
        return None
    links, lenses_held = (
        state.read_links(images, nobody, threads),
        inputs.options.freedom.intrinsics == "held",
    )
    held = {"lenses_held": lenses_held, "rotations_held": inputs.knows_rotations}
    return ask_shape(images, images.posed_rows, links, threads, **held)


def ask_shape(
    images: Images,
    rows: IntArray,
    tracks: Links,
    threads: int,
    *,
    lenses_held: bool = False,
    rotations_held: bool = False,
) -> OpenShape | None:
    """Return what own tracks leave open of where the posed images stand; None if that is not known.

    Args:
        images: all.
        rows: (r,) of those with a pose, which the tracks have in that order.
        tracks: of the model's points.
        threads: number of threads; the answer does not depend on it.
        lenses_held, rotations_held: whether the user knows these.
    """
    if not isinstance(tracks, ObservedTracks) or len(rows) < SMALLEST_SHAPE:
        return None
    held = {"lenses_held": lenses_held, "rotations_held": rotations_held}
    covariances = (
        None
        if all(held.values())
        else estimate_open_shape(images.part(rows), tracks, **held, threads=threads)
    )
    return None if covariances is None else OpenShape.of_images(images, rows, covariances)


def open_beyond_noise(state: ModelState, shape: OpenShape) -> FloatArray:
    """Return the covariances (k, 3, 3) that a shape leaves open beyond its noise, in the solver's unit."""
    judged, scale = state.judged, state.gauge.similarity.scale
    known = np.clip(judged.covariances, -_OPEN, _OPEN)  # a camera that hangs loose has huge ones
    return excess(shape.covariances[judged.cameras] / scale**2, known)


def ask_pixels(source: MatchSource, structure: Structure, doubted: Collection[str]) -> frozenset[str]:
    """Return the names of doubted images that stand where their pixels see the points that the others make.

    There are none where the model has other keypoints than the matches.
    """
    images, view = structure.images, source.view
    if not (doubted and structure.has_keypoints_of(view)):
        return frozenset()
    rows = images.are_named(doubted)
    links = list(view.links(chosen=np.asarray(rows[view.pairs].any(axis=1))))
    sure = are_confirmed(structure, rows, (view.num_keypoints, links))
    return frozenset(images.names_of(np.flatnonzero(sure)))
