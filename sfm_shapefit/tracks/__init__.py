"""Matches joined to tracks, few tracks that cover all cameras, and the points of tracks."""
