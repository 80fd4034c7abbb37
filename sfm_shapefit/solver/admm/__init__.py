"""Splitting for large view graphs."""
