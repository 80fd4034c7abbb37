"""How sfm_shapefit behaves when its input, its machine or its user is against it."""
