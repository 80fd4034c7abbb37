"""Images, matches, poses and what is told of them, as arrays; no files, no solver."""
