"""The points of a model with the images that see them."""

from typing import NamedTuple

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import View
from sfm_shapefit.scene.points import Points


class Structure(NamedTuple):
    """The points of a model, and what they are seen with."""

    points: Points
    images: Images
    """Images where the model has them; NaN where it does not."""
    pictures: KeypointRays
    among: BoolArray | None = None
    """(i,) images that make the points; all if None."""
    asked: BoolArray | None = None
    """(i,) images that are asked whether they contradict their lenses; all if None."""

    def has_keypoints_of(self, view: View) -> bool:
        """Return whether there are points, of the keypoints that the matches have."""
        counts = [self.pictures.count(k) for k in range(self.images.num_images)]
        return self.points.num_points > 0 and counts == view.num_keypoints.tolist()
