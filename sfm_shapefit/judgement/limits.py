"""Limits that several tests of evidence share."""

OUTNUMBERED = 2.0
"""Pairs, or points, for one of two explanations over those for the other: twice as many are believed."""
FEWEST_ALIKE = 3
"""Pairs that say the same; two say the same of something by chance."""
FEWEST_POINTS = 15
"""Points that fit; the six or seven unknowns of an image, or of a group, fit fewer by chance."""
CHECKED_BY = 2
"""Matches of a keypoint in other images that check one another; one may be as false as its pair."""
SMALLEST_SHAPE = 3
"""Cameras, frames or images; fewer have no shape, or no half."""
MOST_COMPARED = 300
"""Turns that are compared with one another; the time grows with the square."""
