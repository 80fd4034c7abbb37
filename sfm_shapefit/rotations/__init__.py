"""Rotations of cameras: averaged ones, and which of the given ones the matches improve."""
