"""The ring between two stages of the pipeline, made by hand: no stage before the tested one has run."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from sfm_shapefit import LocateOptions
from sfm_shapefit.facts.intrinsics import intrinsics_in_doubt
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.template import template_of
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections
from sfm_shapefit.pipeline.given import Given
from sfm_shapefit.pipeline.inputs import MatchSource, choose_inputs, open_source
from sfm_shapefit.pipeline.rigs import find_rigid_parts
from sfm_shapefit.pipeline.stand import Stand
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.placement.place import Placement, place_pieces
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.scene.given import Known
from tests.problems import exact_graph
from tests.scenes import RING

FOLDER, DATABASE = RING / "sparse" / "0", RING / "database.db"


@contextmanager
def opened(model=FOLDER) -> Iterator[MatchSource]:
    """Open the matches of the ring, as the images of a model of it see them."""
    with open_source(read_model(model), choose_inputs(FOLDER, DATABASE)) as source:
        yield source


def placement_at(locations, pairs=None) -> Placement:
    """Return cameras placed at locations (n, 3) by exact directions of pairs, of all if None."""
    (placement,) = place_pieces(MeasuredGraph(exact_graph(locations, pairs)), PlacementOptions())
    return move_cameras(placement, np.asarray(locations))


def stand_at(source, locations, *, all_pairs=True, pull_rad=None, **told) -> Stand:
    """Return all images of a source at some locations, and the gauge by what is told, see `GaugeRule`."""
    images, pairs = source.images, None if all_pairs else source.view.pairs
    rigid = find_rigid_parts(images)
    template = template_of(read_model(FOLDER))
    known = Known(priors=told.pop("priors", None))
    told = {"scale": "auto", "known": known, **told}
    held = np.zeros(len(images.lenses), dtype=np.bool_)
    lenses = intrinsics_in_doubt(held, held, held)
    given = Given(template, images, lenses, source.inputs, rigid, pull_rad, **told)
    directions, placement = directions_of(images, pairs), placement_at(locations, pairs)
    return Stand.of(given, source, directions, placement, LocateOptions())


def directions_of(images, pairs=None) -> PairDirections:
    """Return the exact directions of pairs of images, of all if None, with 100 matches each."""
    graph = exact_graph(images.centers, pairs)
    k = graph.num_edges
    return PairDirections(
        pairs=graph.edges,
        directions=graph.directions,
        status=[DirectionStatus.USABLE] * k,
        num_matches=np.full(k, 100),
        num_inliers=np.full(k, 100),
        num_rivals=np.zeros(k, np.int64),
        cheirality_fraction=np.ones(k),
        median_residual_px=np.full(k, 0.1),
        parallax_deg=np.full(k, 10.0),
        covariance=np.tile(1e-6 * np.eye(2), (k, 1, 1)),
    )
