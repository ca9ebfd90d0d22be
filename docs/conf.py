"""Sphinx configuration; build with ``sphinx-build -W docs docs/_build``."""

import re
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS), str(DOCS.parent), str(DOCS.parent / "tools" / "bench")]

import generate  # noqa: E402

import gsim3d  # noqa: E402

project, author, copyright = "gsim3d", "The gsim3d authors", "The gsim3d authors, Apache-2.0"
release = version = gsim3d.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "_generated/[!.]*", "notes"]
html_theme = "furo"
html_title = f"gsim3d {release}"
html_copy_source = False
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_custom_sections = ["Gradients", "Determinism", "Source", "Sources", "Shapes", "GPU"]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
maximum_signature_line_length = 100


def open_sections(app, what, name, obj, options, lines):
    """Puts the text of ``Gradients: text`` on a line of its own, where napoleon reads it as a section."""
    opened = []
    for line in lines:
        found = re.match(r"(\s*)(Gradients|Determinism|Source|Shapes|GPU): (.+)", line)
        opened += [f"{found[1]}{found[2]}:", f"{found[1]}    {found[3]}"] if found else [line]
    lines[:] = opened


def setup(app):
    """Writes the generated pages before Sphinx reads the sources."""
    app.connect("builder-inited", lambda app: generate.write_pages(DOCS / "_generated"))
    app.connect("autodoc-process-docstring", open_sections, priority=100)
