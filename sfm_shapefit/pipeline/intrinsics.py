"""Which intrinsics are in doubt, and the focal lengths of them that the view graph knows beforehand."""

from sfm_shapefit.adjustment.free_lenses import FreeLenses
from sfm_shapefit.facts.intrinsics import DoubtedIntrinsics
from sfm_shapefit.files.colmap.intrinsics import (
    Origin,
    calibrate_view_graph,
    doubt_lenses,
    find_uncalibrated,
    with_focal_lengths,
)
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.scene.freedom import IntrinsicsFreedom
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import PairNames

_MOST_OFF = 4.0  # factor; a view graph that wants a larger one says more of itself than of the lens


def settle_intrinsics(
    images: Images,
    file: DatabaseFile | None,
    wanted: IntrinsicsFreedom,
    left_out: PairNames = frozenset(),
) -> tuple[Images, DoubtedIntrinsics]:
    """Return the images to start from, and which intrinsics the adjustments may change.

    Args:
        images: as given.
        file: the database, if there is one, which says which intrinsics are guesses.
        wanted: intrinsics that may change.
        left_out: pairs that say nothing of focal lengths.

    Raises:
        InputError: if the database cannot be read.
    """
    guessed = {} if file is None else find_uncalibrated(file, images)
    cameras = {lens.id: lens for lens in images.lenses}
    origins = dict.fromkeys(cameras, Origin.CALIBRATION) if wanted in ("focal", "all") else {}
    origins |= {i: found.origin for i, found in guessed.items()}
    doubts = {} if wanted == "held" else doubt_lenses(cameras, origins)
    factors = {}
    if file is not None and guessed and wanted != "held":
        asked = [found.database_id for found in guessed.values()]
        by_database = calibrate_view_graph(file, asked, left_out)
        factors = {i: by_database[g.database_id] for i, g in guessed.items() if g.database_id in by_database}
        factors = {i: factor for i, factor in factors.items() if 1.0 / _MOST_OFF <= factor <= _MOST_OFF}
    intrinsics = DoubtedIntrinsics(
        given={i: cameras[i] for i in origins},
        origins=origins,
        free=FreeLenses(doubts, distortion=wanted != "focal"),
        view_graph=factors,
    )
    return with_focal_lengths(images, factors), intrinsics
