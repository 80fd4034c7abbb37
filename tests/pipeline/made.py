"""The ring between two stages of the pipeline, made by hand: no stage before the tested one has run."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sfm_shapefit import LocateOptions
from sfm_shapefit.facts.intrinsics import intrinsics_in_doubt
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.files.colmap.template import template_of
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.judgement.measured_pairs import MeasuredPairs
from sfm_shapefit.judgement.support import EvidenceShares, Support
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs, choose_inputs, open_source
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.placement.place import Placement, place_pieces
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.scene.given import Known
from sfm_shapefit.scene.lens import FOCAL, PARTS
from tests.problems import exact_graph, made_directions
from tests.scenes import RING

FOLDER, DATABASE = RING / "sparse" / "0", RING / "database.db"
PAIR = 2147483647  # COLMAP's pair_id is id1 * this + id2


def keep_few_matches(last, most, *, wrong=False):
    """Return an edit of a database: of the pairs between images up to `last` and the others, `most` keep few.

    The rest of them keep no matches; `wrong` ones are of nothing.
    """

    def edit(connection):
        rng = np.random.default_rng(0)
        rows = connection.execute("SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0")
        between = [row for row in rows if (row[0] // PAIR <= last) != (row[0] % PAIR <= last)]
        for rank, (pair, count, data) in enumerate(sorted(between, key=lambda row: -row[1])):
            matches = np.frombuffer(data, np.uint32).reshape(-1, 2)
            matches = matches[rng.permutation(count)[: 12 * (rank < most)]].copy()
            if wrong:
                matches[:, 1] = rng.permutation(matches[:, 1])
            values = len(matches), matches.tobytes(), pair
            connection.execute("UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?", values)

    return edit


@contextmanager
def opened(model=FOLDER) -> Iterator[MatchSource]:
    """Open the matches of the ring, as the images of a model of it see them."""
    with open_source(read_model(model), choose_inputs(FOLDER, DATABASE)) as source:
        yield source


def placement_at(locations, pairs=None) -> Placement:
    """Return cameras placed at locations (n, 3) by exact directions of pairs, of all if None."""
    (placement,) = place_pieces(MeasuredGraph(exact_graph(locations, pairs)), PlacementOptions())
    return move_cameras(placement, np.asarray(locations))


def state_at(source, locations, *, options=None, all_pairs=True, pull_rad=None, **told) -> ModelState:
    """Return all images of a source at some locations, and the frame by what is told, see `RunInputs`."""
    images, pairs = source.images, None if all_pairs else source.view.pairs
    held = np.zeros((len(images.lenses), len(PARTS)), dtype=np.bool_)
    inputs = RunInputs(
        options=options or LocateOptions(),
        template=template_of(read_model(FOLDER)),
        images=images,
        intrinsics=intrinsics_in_doubt(held, held[:, FOCAL]),
        fixed=np.zeros(images.num_images, dtype=np.bool_),
        pull_rad=pull_rad,
        known=Known(priors=told.pop("priors", None)),
        **{"scale": "auto", **told},
    )
    measured = MeasuredPairs(directions=directions_of(images, pairs))
    state = ModelState.of(inputs, source)
    return replace(state, measured=measured, placement=placement_at(locations, pairs)).framed()


def delivered(source) -> ModelState:
    """Return the ring as it is before its gauge is set: at its truth, with its points."""
    model = read_model(FOLDER)
    state = state_at(source, 0.1 * model.images.centers, all_pairs=False)
    nobody = np.zeros(8, dtype=np.bool_)
    return replace(
        state,
        placement=judge(state.placement, PlacementOptions()),
        kept=~nobody,
        images=model.images,
        points=points_of(model.arrays, model.images),
        support=Support(np.full(8, -1), nobody, EvidenceShares(observations=1.0, contradicting=0.0)),
        gauge=state.frame,
        evidence=ModelEvidence(),
    )


def directions_of(images, pairs=None) -> PairDirections:
    """Return the exact directions of pairs of images, of all if None, with 100 matches each."""
    graph = exact_graph(images.centers, pairs)
    return made_directions(graph.edges, graph.directions)
