"""A view graph placed: its rigid pieces solved, refined and judged, and the gauge of the answer."""
