"""Configuration of the documentation site: `make site`."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from lalaloc_core import __version__  # noqa: E402

project = "LaLaLoc"
author = "The LaLaLoc authors"
project_copyright = author
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.apidoc"]
myst_heading_anchors = 3
exclude_patterns = ["tables", "report"]

# Docstrings write code in single backticks.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True, "ignore-module-all": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# The library's query side; training and evaluation are used through the command line.
apidoc_modules = [
    {"path": "../lalaloc_client", "destination": "reference/python/lalaloc_client"},
    {
        "path": "../lalaloc_core",
        "destination": "reference/python/lalaloc_core",
        "exclude_patterns": [f"../lalaloc_core/{wing}" for wing in ("learn", "evaluate", "cli")],
    },
]

# The client and the core have classes of the same names.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = f"LaLaLoc {__version__}"
