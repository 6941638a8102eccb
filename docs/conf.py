"""Sphinx configuration; `make docs` generates docs/reference first. The site loads nothing from other hosts."""

import nedbus

project = "nedbus"
project_copyright = "the nedbus authors, BSD-3-Clause"
release = version = nedbus.__version__
extensions = ["myst_parser"]
exclude_patterns = ["generator"]
html_extra_path = ["vectors.json"]  # at a stable address
nitpicky = True
myst_heading_anchors = 4
html_theme = "furo"
html_title = f"nedbus {release}"
html_copy_source = False
html_show_sphinx = False
