"""Files of other programs, read into plain values and written from them; one module per format."""

from sfm_shapefit.formats.graph_text import graph_text, read_graph

__all__ = ["graph_text", "read_graph"]
