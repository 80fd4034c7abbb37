"""Which scale, origin and axes the output gets: as asked, or by what is known.

The frame that is worked in is chosen for all cameras of a placement, and again for those that are trusted.
The output gets its gauge in one place, `stages.set_gauge`.
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.place_errors import ScaleErrors, draws_at, errors_of_images
from sfm_shapefit.adjustment.scale_bars import fit_scale_bars
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import UNMOVED, Similarity, mean_rotation_l1, rotation_angles_deg
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.control_points import ControlComparison, control_rows, control_warnings, rms_of
from sfm_shapefit.facts.scale_bars import measure_bars
from sfm_shapefit.files.colmap.geodesy import earth, enu_of
from sfm_shapefit.files.colmap.marks import look_at_marks
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.control_points import (
    ControlFit,
    control_gauge,
    fit_control_points,
    triangulate_marks,
)
from sfm_shapefit.placement.gauge_rule import resized_gauge, say_unused
from sfm_shapefit.placement.prior_refinement import PULLED
from sfm_shapefit.scene.given import ControlPoints, EarthDatum, Gravity, ScaleBars
from sfm_shapefit.scene.images import Images
from sfm_shapefit.tracks.structure_options import StructureOptions


def bring_to_gauge(state: ModelState) -> ModelState:
    """Return a model with points in its gauge, chosen anew where it was bundle adjusted or lost cameras.

    The axes of the input are those in which the rotations agree best with the input's. What fixed cameras
    hold of the gauge is held already.
    """
    state, frame = replace(state, gauge=state.frame), state.frame
    lost = state.bundle is not None or (state.support.num_seen >= 0).any()
    if not lost or state.held is not None:
        return state if frame.axes is None else state.moved(turn_about_origin(frame.axes), frame)
    cameras, images = state.placement.cameras[state.kept], state.images
    unit, is_fixed = None if state.placement.unit is None else 1.0, bool(state.inputs.fixed.any())
    if is_fixed and unit is not None:
        return state
    given, present = state.source.images.rotations[cameras], images.rotations[cameras]
    turn = np.eye(3) if is_fixed else mean_rotation_l1(given.transpose(0, 2, 1) @ present)
    chosen = state.gauge_rule.choose(cameras, images.centers[cameras] @ turn.T, unit)
    axes = np.eye(3) if chosen.axes is None else chosen.axes
    scale, shift, earlier = chosen.similarity.scale, chosen.similarity.translation, frame.similarity
    motion = Similarity(scale=scale, rotation=axes @ turn, translation=axes @ shift)
    moved = scale * turn @ earlier.translation + shift
    similarity = replace(earlier, scale=scale * earlier.scale, translation=moved)
    _, mark, pulled = frame.statement.partition(PULLED)  # what pulled the cameras before
    statement = f"{chosen.statement}{mark}{pulled}"
    return state.moved(motion, replace(chosen, similarity=similarity, statement=statement))


def turn_about_origin(rotation: FloatArray) -> Similarity:
    """Return the motion that only turns the world."""
    return Similarity(scale=1.0, rotation=rotation, translation=np.zeros(3))


_ROUNDING = 1e-9  # degrees, and share of the coordinates; less is not told
_NAMED = 3  # images; of more with a wrong gravity only the worst are named


def bring_to_known(state: ModelState) -> ModelState:
    """Return a model in scale and axes of control points, or with z up by gravity, where these are known.

    Points that cannot tell scale and axes leave the model as it is, and so do all where a camera is fixed;
    where the scale is known, they move and turn it only. They check its scale then.
    """
    known = state.inputs.known
    if known.control is not None:
        state = _bring_to_control_points(state, known.control)
    if known.bars is not None:
        state = _bring_to_scale_bars(state, known.bars)
    return state if known.gravity is None else _turn_upright(state, known.gravity)


def _bring_to_control_points(state: ModelState, known: ControlPoints) -> ModelState:
    moves, resize = not state.inputs.fixed.any(), state.placement.unit is None
    images, options = state.images, state.inputs.options.structure
    triangulated = triangulate_marks(known, look_at_marks(images, known), options)
    fit = fit_control_points(known, triangulated.positions, resize=resize or not moves)
    warnings = list(control_warnings(known, triangulated, fit, images.names))
    rows = control_rows(known, triangulated, fit)
    if not (isinstance(fit, str) or (moves and resize)):
        free = fit_control_points(known, triangulated.positions)
        scale = 1.0 if isinstance(free, str) else free.motion.scale
        warnings.append(say_unused("control points were", state.gauge, lambda: scale))
    if not (isinstance(fit, str) or moves):
        rows = [replace(row, use="check") for row in rows]
    state = replace(state.warned(*warnings), control=tuple(rows))
    if isinstance(fit, str) or not moves:
        return state
    return state.moved(fit.motion, control_gauge(state.gauge, known, fit, resize=resize))


def compare_control_points(
    images: Images, known: ControlPoints, datum: EarthDatum | None
) -> tuple[ControlComparison, list[str]]:
    """Return how the posed images of a model, with its datum if it has one, agree with points, and warnings.

    The model is mapped onto the control points, or compared as it stands where these cannot tell how.
    InputError if it cannot be compared so: points on Earth, and a model without a datum.
    """
    if known.datum and datum:
        geodetic = earth().enu_to_ellipsoid(known.positions, *known.datum.geodetic)
        known = replace(known, positions=enu_of(geodetic, datum))
    found = triangulate_marks(known, look_at_marks(images, known), StructureOptions())
    fit, warnings, alignment = fit_control_points(known, found.positions), list[str](), None
    if isinstance(fit, str):
        if known.datum and not datum:
            raise InputError(
                f"{fit}; the model does not say where on Earth it is, so it cannot be compared as it stands: "
                "mark more control points, or give a model that was placed with latitudes and longitudes"
            )
        how = f"as the model stands: {fit}"
        warnings += [] if known.why_too_few() else [how]
        known = replace(known, is_check=np.ones(len(known.names), dtype=np.bool_))
        fit = ControlFit(UNMOVED, ~known.is_check, 0.0, found.positions - known.positions, np.nan)
    else:
        own, alignment = found.positions[fit.fitting], fit.motion.facts
        moved = float(np.linalg.norm((fit.motion.apply(own) - own).mean(axis=0)))
        turned = rotation_angles_deg(fit.motion.rotation[None])[0]
        how = f"after a similarity onto {counted(len(own), 'control point')}: scale {alignment.scale:.6g}"
        how += f", turned by {turned:.3g} deg" if turned > _ROUNDING else ""
        how += f", moved by {moved:.3g}" if moved > _ROUNDING * np.abs(own).max() else ""
    rows = tuple(control_rows(known, found, fit))
    compared = ControlComparison(
        statement=f"{known.statement}; {how}",
        points_from_model=alignment,
        control_rms=rms_of(rows, "control"),
        check_rms=rms_of(rows, "check"),
        points=rows,
    )
    return compared, [*warnings, *control_warnings(known, found, fit, images.names)]


def _bring_to_scale_bars(state: ModelState, known: ScaleBars) -> ModelState:
    """Return a model in the scale of bars, which only check it where something else has set the scale."""
    is_known = state.placement.unit is not None or state.inputs.fixed.any()
    measured = measure_bars(state.images, known, state.estimate, state.inputs.options.structure)
    fit = fit_scale_bars(known, measured.found)
    if fit is not None and not (is_known or state.gauge.scale == "control points"):
        centers = state.images.centers[state.images.is_posed]
        statement = f"scale bars: {known.statement}; {fit.statement}"
        state = state.moved(*resized_gauge(state.gauge, centers, fit.scale, fit.sigma, statement))
        measured = measured.in_scale_of(fit)
    else:
        measured = measured._replace(found=measured.found.in_scale(scale_errors(state)))
        if fit is not None:
            scale = fit.scale
            state = state.warned(say_unused("scale bars were", state.gauge, lambda: scale))
    return replace(state.warned(*measured.warnings()), bars=measured)


def _turn_upright(state: ModelState, gravity: Gravity) -> ModelState:
    """Return a model turned so that z points up, unless something else set its axes."""
    from sfm_shapefit.rotations.gravity import FEWEST_GRAVITIES, down_of, judge_gravity, turn_upright

    images, members = state.images, np.flatnonzero(state.images.is_posed)
    rotations, known = images.rotations[members], gravity.of(members)
    if len(known.indices) < FEWEST_GRAVITIES:
        few = f"{len(known.indices)} of the placed images have a gravity, and two are needed"
        return state.warned(f"{few} to turn the model upright")
    turn = turn_upright(down_of(rotations, known))
    off, wrong = judge_gravity(rotations @ turn.T, known)
    if wrong.any():
        worst = np.flatnonzero(wrong)[np.argsort(-off[wrong], kind="stable")]
        names = [images.names[members[known.indices[k]]] for k in worst[:_NAMED].tolist()]
        state = state.warned(
            f"gravities of {len(worst)} of {len(wrong)} images contradict their rotations and have no part: "
            f"{', '.join(names)}, by up to {np.degrees(off[worst[0]]):.0f} deg"
        )
    if state.gauge.axes is not None:
        return state
    statement = f"{state.gauge.statement}; z up by {int(np.sum(~wrong))} of {len(wrong)} gravities"
    return state.moved(turn_about_origin(turn), replace(state.gauge, axes=turn, statement=statement))


def scale_errors(state: ModelState) -> ScaleErrors:
    """Return the errors of a scale that the adjustment did not have: of bars, distances or control points."""
    gauge, estimate = state.gauge, state.estimate
    if state.bars is not None and state.bars.fit is not None:
        return state.bars.fit.errors
    count = estimate.num_draws if estimate else 0
    draws, sigma = np.zeros(count), 0.0
    if gauge.scale in ("control points", "distance"):
        sigma = gauge.scale_sigma or 0.0
    if gauge.scale == "distance" and count:
        place_of = {name: k for k, name in enumerate(state.images.names)}
        ends = np.array([[place_of[first], place_of[second]] for first, second, _ in state.inputs.distances])
        known = errors_of_images(state.images, draws_at(estimate, state.images)).apart(ends)
        shared = known.length_draws / known.lengths[:, None]
        shared = shared[np.isfinite(shared).all(axis=1)]
        draws = -shared.mean(axis=0) if len(shared) else draws
    return ScaleErrors(draws, sigma)
