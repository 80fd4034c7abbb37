"""Build the API reference of the package, with pdoc, from its docstrings.

    python scripts/api_reference.py docs/api

A page per module that callers use; the public names are on the first. Warnings, as of names that do not
resolve, should be errors: run it with -W error, as scripts/docs does.
"""

import sys
from importlib import import_module
from pathlib import Path

import pdoc

NAMES = (
    *("base.errors", "scene.evaluation", "facts.options", "facts.result", "facts.map_result", "facts.tables"),
    *("files.colmap.model", "files.colmap.quiet", "files.g2o", "files.glomap_text", "files.graph_text"),
    *("files.nerf", "files.onedsfm", "files.opensfm", "files.tum", "pipeline", "pairs", "judgement"),
    *("graph.rigidity", "graph.viewgraph", "placement.place", "placement.gauge", "placement.diagnosis"),
    *("solver", "synthetic", "synthetic.fixtures", "synthetic.rendered_workspace", "synthetic.workspace"),
)
MODULES = ("sfm_shapefit", *(f"sfm_shapefit.{name}" for name in NAMES))


def build(out: Path) -> None:
    """Write the pages into a folder."""
    for module in map(import_module, MODULES):
        for name in getattr(module, "__all__", ()):
            getattr(module, name)  # pdoc sees only what is there, and some is imported at its first use
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*MODULES, output_directory=out)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
