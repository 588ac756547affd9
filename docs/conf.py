"""Sphinx settings of the site that `make docs` builds.

The source folder is the root of the repository: links between the README, `docs/` and the other pages are the same
here and on GitHub. Generated files go to `build/`.
"""

import sys
from pathlib import Path

from sionna_partial import __version__

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))

project = "sionna_partial"
author = project_copyright = "The sionna_partial developers"
release = version = __version__

root_doc = "README"
highlight_language = "none"  # of blocks that name no language: commands of a shell
include_patterns = ["*.md", "benchmarks/*.md", "docs/**", "build/api/**", "build/gallery/**"]
exclude_patterns = [
    *(".*", "sionna_partial", "tests", "scenes", "dist", "build/docs", "build/doctrees", "build/notebooks"),
    *(
        "docs/_templates",
        "build/gallery/**.ipynb",
        "build/gallery/**.py",
        "build/gallery/**.md5",
        "build/gallery/**.json",
    ),
]
extensions = [
    *("site_parts", "myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc"),
    "sphinx_gallery.gen_gallery",
]
templates_path = [str(ROOT / "docs" / "_templates")]  # autosummary looks in the source folder

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = html_show_sourcelink = False
html_sidebars = {"**": ["contents.html"]}
html_theme_options = {"navbar_center": [], "secondary_sidebar_items": ["page-toc"], "navbar_end": ["theme-switcher"]}

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_ipywidgets_js = {}  # pages load nothing from other sites
nb_output_stderr = "remove"  # progress bars

autodoc_typehints = "none"
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "build/gallery",
    "filename_pattern": r"\.py$",
    "image_scrapers": ("site_parts.figures",),
    "abort_on_example_error": True,
    "capture_repr": (),
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
}
