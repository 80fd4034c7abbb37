"""From a convex start to the locations that are kept: starts compared, refined in angles, strays reset."""
