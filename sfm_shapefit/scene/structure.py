"""The points of a model with the images that see them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.row_file import Widened
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import View
from sfm_shapefit.scene.points import Points


@dataclass(frozen=True, eq=False)
class Structure:
    """The points of a model, and what they are seen with."""

    points: Points
    images: Images
    """Images where the model has them; NaN where it does not."""
    pictures: KeypointRays
    among: BoolArray | None = None
    """(i,) images that make the points; all if None."""
    asked: BoolArray | None = None
    """(i,) images that are asked whether they contradict their lenses; all if None."""

    @cached_property
    def rows_of_images(self) -> RowLists:
        """The observations of each image, ascending."""
        return self.points.rows_of_images(self.images.num_images)

    @cached_property
    def pixels(self) -> Widened:
        """Where the observations are, (o, 2); read once for all that ask."""
        stored: npt.NDArray[np.floating] = np.zeros((len(self.points.images), 2), dtype=np.float32)
        for image, rows in enumerate(self.rows_of_images):
            if len(rows):
                pixels = self.pictures.pixels(image, self.points.keypoints[rows])
                with np.errstate(over="ignore"):
                    stored[rows] = pixels
                if not np.array_equal(stored[rows], pixels, equal_nan=True):  # 32 bits do not do
                    stored = stored.astype(np.float64)
                    stored[rows] = pixels
        return Widened(stored)

    def has_keypoints_of(self, view: View) -> bool:
        """Return whether there are points, of the keypoints that the matches have."""
        counts = [self.pictures.count(k) for k in range(self.images.num_images)]
        return self.points.num_points > 0 and counts == view.num_keypoints.tolist()
