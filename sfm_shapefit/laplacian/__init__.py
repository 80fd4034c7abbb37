"""Linear algebra of view graphs; knows nothing of cameras."""
