"""Places the cameras of a COLMAP model from known rotations: certified, explained, deterministic."""
