"""Limits that several tests of evidence share, and what follows from them.

A statement of chance stands behind each: what sound pairs, points and cameras hardly ever do by themselves.
"""

OUTNUMBERED = 2.0
"""Ratio of pairs, points, residuals or shares for one of two explanations to those for the other; one that
has twice as many is believed."""
RIVAL_SHARE = 1.0 / OUTNUMBERED
"""Share of those for the other explanation that one needs at least to be its rival."""
MOST_AGAINST = 1.0 / (1.0 + OUTNUMBERED)
"""Share of the pairs of a camera, or of the cameras, that may contradict; the rest outnumbers no more."""
LOCAL_SHARE = 0.1
"""Share of cameras, of pairs, or of the spread of the scene; less is local and leaves the whole as it is."""
CHANCE_SHARE = 0.05
"""Share of sound pairs or cameras that are off by chance. Also the largest error of a sound camera, as a
share of the extent."""
SIGMAS = 3.0
"""Standard deviations; what is farther off is no noise."""
SURE_SIGMAS = OUTNUMBERED * SIGMAS
"""Levels of a median of unlike pairs or cameras; their own noise is up to twice what is usual."""
KNOWN_DEG = 1.0
"""Degrees, standard deviation of the direction and of the turn of a pair by itself; few know theirs worse."""
ALIKE_DEG = SIGMAS * KNOWN_DEG
"""Degrees between turns, or to a place, of pairs that say the same."""
NEAR_DEG = RIVAL_SHARE * KNOWN_DEG
"""Degrees; what is nearer is no other place, and no other turn."""
FEWEST_ALIKE = 3
"""Pairs that say the same; two say the same of something by chance."""
FEWEST_POINTS = 15
"""Points that fit; the six or seven unknowns of an image, or of a group, fit fewer by chance."""
CHECKED_BY = 2
"""Matches of a keypoint in other images that check one another; one may be as false as its pair."""
SMALLEST_SHAPE = 3
"""Cameras, frames or images; fewer have no shape, or no half."""
FITTING_PX = 4.0
"""Pixels; what misses its point by more does not fit, as COLMAP has it."""
MOST_COMPARED = 300
"""Turns that are compared with one another; the time grows with the square."""
