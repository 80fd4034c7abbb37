"""Joins of models: judged by what ties their pieces, carried out group by group, and the joined model judged.

pieces and ties -> votes, program, refinement, judgement (`placement.join`)
    -> position priors where these are not enough -> groups merged -> judged as `check` does

Nothing is placed anew. What the models know of their own cameras is kept, see `facts.joined_cameras`.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.scale_bars import fit_scale_bars
from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import UNMOVED, Similarity, angle_between, compose, median_spread
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.facts.joined_cameras import JoinedGroup, JoinInputs, tell_joined
from sfm_shapefit.facts.joins import JoinFacts
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.scale_bars import compare_bars
from sfm_shapefit.files.colmap.merge import merge_models
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.priors import MissingPriorsError, database_priors
from sfm_shapefit.files.colmap.reconstructions import transform_model
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline.components import MapContext
from sfm_shapefit.pipeline.inputs import MatchSource, see_matches
from sfm_shapefit.pipeline.pieces import ModelPiece, TiedPieces, tie_pieces
from sfm_shapefit.pipeline.referee import check_source
from sfm_shapefit.placement.gauge import ARBITRARY, Gauge
from sfm_shapefit.placement.gauge_rule import gauge_of_distances, resized_gauge
from sfm_shapefit.placement.join import AGREEING_PX, UNTIED, PieceJoin, join_pieces
from sfm_shapefit.placement.prior_join import join_to_earlier, try_priors
from sfm_shapefit.scene.given import PositionPriors


def judge_joins(
    pieces: Sequence[ModelPiece], tied: TiedPieces, priors: Sequence[PositionPriors | None] = ()
) -> Iterator[JoinFacts]:
    """Yield what comes of joining each piece but the first: by pairs, or else by `priors` of its cameras."""
    outcomes = join_pieces(tied.cameras, tied.ties)
    usable = [] if tied.cameras.is_metric.any() else priors
    placed = [try_priors(tied.cameras.centers_of(k), one) for k, one in enumerate(usable)]
    for number in range(1, len(pieces)):
        done = outcomes[number]
        if placed and (not isinstance(done, PieceJoin) or done.reason):
            other = join_to_earlier(number, placed)
            done = other if isinstance(other, PieceJoin) or done == UNTIED else done
        join = _at_known_scale(pieces, done) if isinstance(done, PieceJoin) else None
        pairs = [] if join is None else tied.ties.matches.pairs[join.rivals].tolist()
        rivals = [(tied.names[v], tied.names[w]) for v, w in pairs]
        yield JoinFacts.of_models([piece.label for piece in pieces], number, join or str(done), rivals)


def _at_known_scale(pieces: Sequence[ModelPiece], join: PieceJoin) -> PieceJoin:
    """Return a join with the errors of scales that rigs have; refused where only one model has rigs."""
    two = pieces[join.to], pieces[join.piece]
    if not any(one.model.images.has_rigs for one in two):
        return join
    if not all(one.model.images.has_rigs for one in two):
        return replace(join, reason="only one of them has rigs of several cameras, and a scale by that")
    if not all(one.is_metric for one in two):
        return replace(join, reason="their rigs do not give the scale of both")
    sigma = float(np.linalg.norm([one.scale_sigma or 0.0 for one in two]))
    # Errors of the size of the second model move its cameras about their middle.
    center_sigma = float(np.hypot(join.center_sigma, sigma * median_spread(two[1].model.images.centers)))
    return replace(join, scale_sigma=sigma, center_sigma=center_sigma)


def merge_groups(
    pieces: Sequence[ModelPiece], tied: TiedPieces, joins: Sequence[JoinFacts]
) -> list[JoinedGroup]:
    """Return the pieces that were joined, each group in the world of its first."""
    growing: dict[int, _Growing] = {}
    root = list(range(len(pieces)))
    for done in joins:
        if done.join is not None:
            first = root[done.number] = root[done.to_number]
            group = growing[first] = growing.get(first) or _Growing(pieces[first], first)
            group.add(done, pieces[done.number], tied)
    return [growing[number].group for number in sorted(growing)]


class _Growing:
    """A group of joined pieces as it grows, and the ids that its points have."""

    def __init__(self, piece: ModelPiece, number: int) -> None:
        reconstruction = piece.model.reconstruction
        self.group = JoinedGroup(reconstruction, {number: UNMOVED}, ())
        self.ids: dict[int, dict[int, int]] = {number: {i: i for i in reconstruction.point3D_ids()}}
        """New ids of each piece's points, by the old ones."""

    def add(self, done: JoinFacts, piece: ModelPiece, tied: TiedPieces) -> None:
        assert done.join is not None
        world_from = compose(self.group.world_from[done.to_number], done.join.to_from_piece)
        worlds = {**self.group.world_from, done.number: world_from}
        same = self._same_points(done.join, worlds, tied)
        ours, theirs = self.group.reconstruction, piece.model.reconstruction
        merged, renamed, new = merge_models(ours, theirs, world_from, same)
        for number, ids in self.ids.items():
            self.ids[number] = {point: renamed.get(now, now) for point, now in ids.items()}
        self.ids[done.number] = new
        ends = [np.flatnonzero(tied.cameras.piece_of == k)[:2] for k in (done.number, done.to_number)]
        names = dict.fromkeys(tied.names[v] for v in np.concatenate(ends).tolist())
        known = (*self.group.tied, *itertools.combinations(names, 2))
        self.group = JoinedGroup(merged, worlds, (*self.group.joins, done), known)

    def _same_points(
        self, join: PieceJoin, worlds: dict[int, Similarity], tied: TiedPieces
    ) -> list[tuple[int, int]]:
        """Return points of the group and of a new piece that are one by the pairs that agree; each once."""
        pieces = tied.cameras.piece_of[tied.ties.matches.pairs]
        same: dict[int, int] = {}
        for pair in join.agreeing.tolist():
            way = int(pieces[pair, 1] == join.piece)
            other = int(pieces[pair, 1 - way])
            if other not in self.ids:
                continue
            rows, fits = _fitting(tied, pair, worlds)
            for ids in tied.keypoints[rows][fits].tolist():
                one = self.ids[other].get(ids[1 - way])
                if one is not None and ids[way] >= 0 and one not in same.values():
                    same.setdefault(ids[way], one)
        return [(one, other) for other, one in same.items()]


def _fitting(tied: TiedPieces, pair: int, worlds: dict[int, Similarity]) -> tuple[slice, BoolArray]:
    """Return the matches of a pair, and which of them see, from each side, the point of the other side."""
    ties = tied.ties.matches
    rows = ties.slice_of(pair)
    off, ends = np.zeros(rows.stop - rows.start), ties.pairs[pair].tolist()
    end_worlds = [worlds[int(tied.cameras.piece_of[v])] for v in ends]
    for way, rays in enumerate((ties.rays_i[rows], ties.rays_j[rows])):
        seen = end_worlds[1 - way].apply(tied.ties.points[rows, 1 - way])
        eye = end_worlds[way].apply(tied.cameras.centers[ends[way]][None])
        looks = rays @ tied.cameras.rotations[ends[way]] @ end_worlds[way].rotation.T
        off = np.maximum(off, angle_between(seen - eye, looks))
    return rows, np.asarray(off <= AGREEING_PX * ties.pixel_angles[pair])


def tell_group(
    group: JoinedGroup, join_inputs: JoinInputs, source: MatchSource, options: DirectionOptions, clock: Clock
) -> JoinedModel:
    """Return joined models, judged as `check` does; `source` has the matches of their images."""
    first, located = next(iter(group.world_from)), join_inputs.located
    gauge = Gauge(scale="input", similarity=UNMOVED, statement="input: those of the first model")
    if first in located:
        gauge, group = _choose_scale(group, located[first].gauge, join_inputs)
    model = read_model(group.reconstruction)
    rows = {name: k for k, name in enumerate(model.images.names)}
    tied = np.array([(rows[a], rows[b]) for a, b in group.tied], dtype=np.int64).reshape(-1, 2)
    source = replace(source.at(model.images), tied=tied)
    checked = check_source(model, source, options, clock)
    return tell_joined(group, join_inputs, checked, gauge)


def _choose_scale(group: JoinedGroup, first: Gauge, join_inputs: JoinInputs) -> tuple[Gauge, JoinedGroup]:
    """Return the gauge of joined models, and the models in it.

    A scale that the first model knows stays. An arbitrary scale gives way to scale bars or known distances,
    within a model or between two.
    """
    images, warning = read_model(group.reconstruction).images, ""
    distances = [one for one in join_inputs.distances if {*one[:2]} <= {*images.names}]
    if first.scale in ARBITRARY:
        known = join_inputs.bars
        fit = known and fit_scale_bars(known, compare_bars(images, known, None, None).found)
        if known and fit:
            said = f"scale bars: {known.statement}; {fit.statement}"
            motion, gauge = resized_gauge(first, images.centers, fit.scale, fit.sigma, said)
            return gauge, _moved(group, motion)
        try:
            if distances:
                gauge = gauge_of_distances(images.names, images.centers, distances)
                return gauge, _moved(group, gauge.similarity)
        except InputError as error:  # two cameras stand in one place
            warning = str(error)
    statement = f"that of model {next(iter(group.world_from))}: {first.statement}"
    return replace(first, statement=statement, warning=warning), group


def _moved(group: JoinedGroup, motion: Similarity) -> JoinedGroup:
    """Return joined models after a similarity of their world."""
    return group._replace(
        reconstruction=transform_model(group.reconstruction, motion),
        world_from={number: compose(motion, one) for number, one in group.world_from.items()},
    )


def join_mapped(
    models: Sequence[LocateResult], run: MapContext
) -> tuple[tuple[JoinFacts, ...], tuple[JoinedModel, ...], tuple[str, ...]]:
    """Join the models of a run, largest first, where that is safe and wanted.

    Returns:
        What came of joining each model but the largest, the models in one world, larger ones first, and what
        was told and could not be used for it, a sentence each.
    """
    if len(models) < 2 or run.options.join == "never":
        return (), (), ()
    located = dict(enumerate(models))
    pieces = [
        ModelPiece(
            label=f"model {number}",
            model=read_model(one.model.arrays()),
            scale_sigma=(one.gauge.scale_sigma or 0.0) if one.images.has_rigs else None,
        )
        for number, one in located.items()
    ]
    warnings: list[str] = []
    priors = list(_priors_of(pieces, run, warnings))
    tied = tie_pieces(pieces, run.matches, run.without)
    joins = list(judge_joins(pieces, tied, priors))
    options, inputs = run.options, run.inputs
    join_inputs = JoinInputs(
        joins, flat_values(options), inputs, options.gauge.known_distance, located=located
    )
    joined = []
    for group in merge_groups(pieces, tied, joins):
        images = read_model(group.reconstruction).images
        rows = np.searchsorted(run.images.names, images.names)
        told = join_inputs._replace(bars=run.known.bars and run.known.bars.of(rows))
        source = see_matches(run.matches, images, inputs)
        joined.append(tell_group(group, told, source, options.directions, run.clock.anew()))
    return tuple(joins), tuple(joined), tuple(warnings)


def _priors_of(
    pieces: Sequence[ModelPiece], run: MapContext, warnings: list[str]
) -> Iterator[PositionPriors | None]:
    """Yield the position priors of the images of each piece, told or those of the database."""
    priors = run.known.priors
    if priors is None:
        try:
            priors = database_priors(run.matches.file, run.images)
        except MissingPriorsError:
            pass
        except InputError as error:
            warnings.append(f"the position priors of the database join no models: {error}")
    for piece in pieces:
        piece_priors = (
            None if priors is None else priors.of(np.searchsorted(run.images.names, piece.model.images.names))
        )
        yield piece_priors if piece_priors else None
