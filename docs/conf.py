"""How the documentation is built: `make docs`, without the network; a warning is an error.

Pages in Markdown (MyST) lie beside this file; reference pages whose content is the code's own (scenario keys, verbs, metrics,
estimators, sensors) are written anew by `extensions.generated` in every build, and the gallery runs its scripts.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))
os.environ.setdefault("COLUMNS", "100")

import testbed

project = "Navigation testbed"
author = "The navigation testbed contributors"
copyright = f"2026, {author}"
release = version = testbed.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_gallery.gen_gallery",
    "extensions.mathml",
    "extensions.generated",
]
exclude_patterns = ["gallery/README.rst", "build", "**/GALLERY_HEADER.rst"]
default_role = "py:obj"
nitpicky = False
suppress_warnings = ["config.cache", "myst.xref_missing"]

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 3
myst_links_external_new_tab = False

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 90

html_theme = "furo"
html_title = f"Navigation testbed {release}"
html_static_path = ["_static"]
html_css_files = ["testbed.css"]
html_theme_options = {"navigation_with_keys": True}
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
pygments_style = "tango"

from extensions.figures import returned_figures
from sphinx_gallery.sorting import FileNameSortKey

sphinx_gallery_conf = {
    "examples_dirs": ["gallery"],
    "gallery_dirs": ["auto_gallery"],
    "filename_pattern": r"/\d\d_",
    "ignore_pattern": r"__init__\.py",
    "within_subsection_order": FileNameSortKey,
    "abort_on_example_error": True,
    "only_warn_on_example_error": False,
    "show_memory": False,
    "min_reported_time": 20,
    "remove_config_comments": True,
    "show_signature": False,
    "download_all_examples": False,
    "image_scrapers": ("matplotlib", returned_figures),
    "capture_repr": ("_repr_html_",),
    "plot_gallery": True,
    "default_thumb_file": None,
    "show_api_usage": False,
    "reset_modules": ("matplotlib",),
}
