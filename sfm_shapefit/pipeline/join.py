"""`join`: models of one scene in one world, by one convex program; for `map`, its components and pieces.

models and matches -> ties between pieces -> votes, program, refinement, judgement (`placement.join`)
    -> position priors where these are not enough -> groups merged -> adjusted -> judged as `check` does
"""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import sfm_shapefit.pipeline.write  # noqa: F401  so that results show their report in notebooks
from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import Similarity, angle_between, compose, median_spread
from sfm_shapefit.base.settings import flat_values, merge_options
from sfm_shapefit.facts.joins import Joined
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.options import JoinOptions
from sfm_shapefit.facts.result import Inputs, LocateResult
from sfm_shapefit.files.colmap.database import open_database
from sfm_shapefit.files.colmap.merge import merge_models
from sfm_shapefit.files.colmap.model import read_model, renamed_as
from sfm_shapefit.files.colmap.priors import MissingPriorsError, database_priors
from sfm_shapefit.pipeline.adjust import bundle_adjust
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source, read_left_out, see_matches
from sfm_shapefit.pipeline.joined import JoinedGroup, Told, tell_group
from sfm_shapefit.pipeline.mapping import MapRun
from sfm_shapefit.pipeline.pieces import ModelPiece, TiedPieces, tie_pieces
from sfm_shapefit.placement.join import AGREEING_PX, UNTIED, PieceJoin, join_pieces
from sfm_shapefit.placement.prior_join import PlacedByPriors, join_by_priors, place_by_priors
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.solver.options import SolverOptions

if TYPE_CHECKING:
    import pycolmap


def join(
    models: "Sequence[pycolmap.Reconstruction | Path | str]",
    database: Path | str | None = None,
    *,
    options: JoinOptions | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> JoinedModel:
    """Place models of one scene in one world: pieces of one capture, or captures of one place.

        found = sfm_shapefit.join(["sparse/0", "sparse/1"], "database.db")
        sfm_shapefit.write_result(found, "out")

    Args:
        models: two or more model folders or reconstructions, of any program in COLMAP's form; none is
            changed. The world is that of the first.
        database: the COLMAP database with the matches between their images. Without it, `database.db` is
            looked for beside the first model, as for `locate`; failing that, or if it lacks images of the
            others, images that two models share tie them.
        options: settings, see `help(JoinOptions)`; defaults if None.
        progress: called as stages advance.
        **overrides: single options by name.

    Returns:
        The models that could be joined, `joins` with how and how surely, or why not, and the verdict.

    Raises:
        InputError: if models or database cannot be used, or nothing ties the models to one another.
        UnsolvableError: if no two models can be joined safely; the message says why.
    """
    options = merge_options(options, JoinOptions, overrides)
    clock = Clock.of(progress, SolverOptions())
    with clock("read"):
        if isinstance(models, Path | str) or len(models) < 2:
            raise InputError("a join needs two models or more; give their folders one after the other")
        inputs = choose_inputs(models[0], database)
        pieces = _read(models, inputs.database)
        names = sorted({name for piece in pieces for name in piece.model.images.names})
        shares = len(names) < sum(piece.model.images.num_images for piece in pieces)
        if inputs.database is None or (shares and database is None):
            inputs = _without_foreign(inputs, names)
        inputs = read_left_out(inputs, names, options.directions.without)
    with ExitStack() as stack:
        with clock("ties"):
            matches = None
            if inputs.database is not None:
                matches = stack.enter_context(_opened(pieces, inputs.database, names))
            elif not shares:
                raise InputError(
                    "the models share no image, and there is no database with matches between them; give "
                    "one with --database"
                )
            tied = tie_pieces(pieces, matches, inputs.left_out)
        with clock("join"):
            joins = list(judge_joins(pieces, tied))
            groups = merge_groups(pieces, tied, joins)
        if not groups:
            raise UnsolvableError("; ".join(one.statement for one in joins))
        group = max(groups, key=lambda group: group.reconstruction.num_reg_images())
    if options.adjust == "full":
        with clock("adjustment"):
            group = group._replace(reconstruction=bundle_adjust(group.reconstruction).reconstruction)
    notes = [f"{piece.label}: {note}" for piece in pieces for note in piece.model.notes]
    told = Told(joins, flat_values(options), inputs, notes=notes)
    with open_source(read_model(group.reconstruction), inputs) as source:
        return tell_group(group, told, source, options.directions, clock)


def _read(
    models: "Sequence[pycolmap.Reconstruction | Path | str]", database: Path | None
) -> list[ModelPiece]:
    """Read the models, and refuse those that have nothing to join."""
    pieces: list[ModelPiece] = []
    found = [*map(read_model, models)]
    every = {name for model in found for name in model.images.names}
    # A database that has all of them, each under its own name, says that they are different images.
    are_different = False
    with suppress(InputError):  # what is wrong with a database is said where it is opened for its matches
        are_different = database is not None and not _missing(database, every)
    for number, (source, model) in enumerate(zip(models, found, strict=True)):
        label = str(source) if isinstance(source, Path | str) else f"model {number}"
        names = dict.fromkeys(name for piece in pieces for name in piece.model.images.names)
        piece = ModelPiece(label=label, model=model if are_different else renamed_as(model, list(names)))
        for earlier in pieces:
            if {*piece.model.images.names} <= {*earlier.model.images.names}:
                raise InputError(
                    f"every image of {label} is in {earlier.label} too, so that there is nothing to join; "
                    "leave out one of them"
                )
        pieces.append(piece)
    rigs = [piece.model.images.has_rigs for piece in pieces]
    if any(rigs) and not all(rigs):
        raise InputError(
            f"{pieces[rigs.index(True)].label} has rigs of several cameras, and a scale by that, but "
            f"{pieces[rigs.index(False)].label} has none; give both the same rigs"
        )
    return [replace(piece, scale_sigma=0.0) for piece in pieces] if any(rigs) else pieces


def _missing(database: Path, names: Collection[str]) -> tuple[str, ...]:
    """Return the names of images that a database lacks."""
    with closing(open_database(database, sorted(names))) as matches:
        return matches.missing_names


def _without_foreign(inputs: Inputs, names: Sequence[str]) -> Inputs:
    """Return the inputs without a database that was only found, and is that of the first model alone."""
    shared, path = "images that the models share", inputs.database
    if path is None:
        return replace(inputs, statement=shared)
    try:
        missing = _missing(path, names)
    except InputError as error:
        return replace(inputs, database=None, statement=f"{shared}; the database beside the first: {error}")
    if not missing:
        return inputs
    told = f"{shared}; {path}, found beside the first, lacks {len(missing)} of {len(names)} images"
    return replace(inputs, database=None, statement=told)


def _opened(pieces: Sequence[ModelPiece], database: Path, names: Sequence[str]) -> Any:
    """Open a database, and refuse one that knows no image of a model."""
    matches = open_database(database, names)
    missing = {*matches.missing_names}
    for piece in pieces:
        if {*piece.model.images.names} <= missing:
            matches.close()
            raise InputError(
                f"{database} has no image of {piece.label}, such as {piece.model.images.names[0]}; give the "
                "database that all models were made from"
            )
    return closing(matches)


def judge_joins(
    pieces: Sequence[ModelPiece], tied: TiedPieces, priors: Sequence[PositionPriors | None] = ()
) -> Iterator[Joined]:
    """Yield what comes of joining each piece but the first: by pairs, or else by `priors` of its cameras."""
    found = join_pieces(tied.cameras, tied.ties)
    usable = [] if tied.cameras.is_metric.any() else priors
    placed = [_on_priors(tied.cameras.centers_of(k), one) for k, one in enumerate(usable)]
    for number in range(1, len(pieces)):
        done = found[number]
        if placed and (not isinstance(done, PieceJoin) or done.reason):
            other = _join_by_priors(number, placed)
            done = other if isinstance(other, PieceJoin) or done == UNTIED else done
        join = _at_known_scale(pieces, done) if isinstance(done, PieceJoin) else None
        to = 0 if join is None else join.to
        pairs = [] if join is None else tied.ties.matches.pairs[join.rivals].tolist()
        yield Joined(
            model=number,
            to=to,
            found=join,
            reason=str(done) if join is None else join.reason,
            labels=(pieces[number].label, pieces[to].label),
            rivals=tuple((tied.names[v], tied.names[w]) for v, w in pairs),
        )


def _at_known_scale(pieces: Sequence[ModelPiece], join: PieceJoin) -> PieceJoin:
    """Return a join with the errors of scales that rigs have; refused where only one model has rigs."""
    two = pieces[join.to], pieces[join.piece]
    if not any(one.model.images.has_rigs for one in two):
        return join
    if not all(one.model.images.has_rigs for one in two):
        return replace(join, reason="only one of them has rigs of several cameras, and a scale by that")
    if not all(one.is_metric for one in two):
        return replace(join, reason="their rigs do not tell the scale of both")
    sigma = float(np.linalg.norm([one.scale_sigma or 0.0 for one in two]))
    # Errors of the size of the second model move its cameras about their middle.
    center_sigma = float(np.hypot(join.center_sigma, sigma * median_spread(two[1].model.images.centers)))
    return replace(join, scale_sigma=sigma, center_sigma=center_sigma)


def _on_priors(centers: FloatArray, priors: PositionPriors | None) -> PlacedByPriors | str:
    """Return a piece on the position priors of its cameras, or why it is not placed by them."""
    try:
        return UNTIED if priors is None else place_by_priors(centers, priors)
    except UnsolvableError as error:
        return str(error)


def _join_by_priors(number: int, placed: Sequence[PlacedByPriors | str]) -> PieceJoin | str:
    """Return the join of a piece to the first of the earlier ones that priors allow, or why there is none."""
    own, reasons = placed[number], list[str]()
    for to, other in enumerate(placed[:number]):
        if isinstance(own, str) or isinstance(other, str):
            reasons.append(own if isinstance(own, str) else str(other))
            continue
        try:
            return join_by_priors((to, other), (number, own))
        except UnsolvableError as error:
            reasons.append(str(error))
    return next((reason for reason in reasons if reason != UNTIED), UNTIED)


def merge_groups(
    pieces: Sequence[ModelPiece], tied: TiedPieces, joins: Sequence[Joined]
) -> list[JoinedGroup]:
    """Return the pieces that were joined, each group in the world of its first."""
    growing: dict[int, _Growing] = {}
    root = list(range(len(pieces)))
    for done in joins:
        if done.join is not None:
            first = root[done.model] = root[done.to]
            group = growing[first] = growing.get(first) or _Growing(pieces[first], first)
            group.add(done, pieces[done.model], tied)
    return [growing[number].group for number in sorted(growing)]


class _Growing:
    """A group of joined pieces as it grows, and the ids that its points have."""

    def __init__(self, piece: ModelPiece, number: int) -> None:
        reconstruction = piece.model.reconstruction
        same = Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))
        self.group = JoinedGroup(reconstruction, {number: same}, ())
        self.ids: dict[int, Mapping[int, int]] = {number: {i: i for i in reconstruction.point3D_ids()}}
        """New ids of each piece's points, by the old ones."""

    def add(self, done: Joined, piece: ModelPiece, tied: TiedPieces) -> None:
        """Take in a piece that was joined to one of the group."""
        assert done.join is not None
        world_from = compose(self.group.world_from[done.to], done.join.to_from_piece)
        worlds = {**self.group.world_from, done.model: world_from}
        same = self._same_points(done.join, worlds, tied)
        ours, theirs = self.group.reconstruction, piece.model.reconstruction
        merged, renamed, new = merge_models(ours, theirs, world_from, same)
        for number, ids in self.ids.items():
            self.ids[number] = {point: renamed.get(now, now) for point, now in ids.items()}
        self.ids[done.model] = new
        ends = [np.flatnonzero(tied.cameras.piece_of == k)[:2] for k in (done.model, done.to)]
        names = dict.fromkeys(tied.names[v] for v in np.concatenate(ends).tolist())
        known = (*self.group.tied, *itertools.combinations(names, 2))
        self.group = JoinedGroup(merged, worlds, (*self.group.joins, done), known)

    def _same_points(
        self, join: PieceJoin, worlds: Mapping[int, Similarity], tied: TiedPieces
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


def _fitting(tied: TiedPieces, pair: int, worlds: Mapping[int, Similarity]) -> tuple[slice, BoolArray]:
    """Return the matches of a pair, and which of them see, from each side, the point of the other side."""
    ties = tied.ties.matches
    rows = slice(*ties.offsets[pair : pair + 2].tolist())
    off, ends = np.zeros(rows.stop - rows.start), ties.pairs[pair].tolist()
    own = [worlds[int(tied.cameras.piece_of[v])] for v in ends]
    for way, rays in enumerate((ties.rays_i[rows], ties.rays_j[rows])):
        seen = own[1 - way].apply(tied.ties.points[rows, 1 - way])
        eye = own[way].apply(tied.cameras.centers[ends[way]][None])
        looks = rays @ tied.cameras.rotations[ends[way]] @ own[way].rotation.T
        off = np.maximum(off, angle_between(seen - eye, looks))
    return rows, np.asarray(off <= AGREEING_PX * ties.pixel_angles[pair])


def join_mapped(
    models: Sequence[LocateResult], run: MapRun
) -> tuple[tuple[Joined, ...], tuple[JoinedModel, ...], tuple[str, ...]]:
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
    told = Told(joins, flat_values(options), inputs, options.gauge.known_distance, located)
    joined = []
    for group in merge_groups(pieces, tied, joins):
        source = see_matches(run.matches, read_model(group.reconstruction).images, inputs)
        joined.append(tell_group(group, told, source, options.directions, run.clock.anew()))
    return tuple(joins), tuple(joined), tuple(warnings)


def _priors_of(
    pieces: Sequence[ModelPiece], run: MapRun, warnings: list[str]
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
        own = (
            None if priors is None else priors.of(np.searchsorted(run.images.names, piece.model.images.names))
        )
        yield own if own else None
