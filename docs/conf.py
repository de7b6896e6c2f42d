"""The site: ``make docs`` builds it from these pages, the notebooks and the code, without a network."""

from __future__ import annotations

import sys
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
sys.path.insert(0, str(HERE.parent))

project = "magloc"
author = "the magloc developers"
copyright = f"{author}, BSD 3-Clause licence"
release = version = installed("magloc")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_nb",
    "sphinx_design",
    "made_pages",
]
exclude_patterns = ["_build", "templates", "static", "reference/names/all.md"]
templates_path = ["templates"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "amsmath"]
# Two hyphens begin an option.
smartquotes = False
myst_heading_anchors = 3
# Notebooks are kept with their outputs, and executed by the tests.
nb_execution_mode = "off"
nb_merge_streams = True
# Otherwise tables that a cell displays show as text.
nb_render_markdown_format = "myst"
nb_code_prompt_show = "Show the code that draws this"
nb_code_prompt_hide = "Hide the code that draws this"

# Two pages that differ by case alone are one file on macOS and Windows.
autosummary_filename_map = {"magloc.Survey": "magloc.Survey-class", "magloc.Track": "magloc.Track-class"}
autodoc_typehints = "none"
autodoc_member_order = "groupwise"
autodoc_preserve_defaults = True
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

# One file of MathJax, which holds its fonts too: formulas show without a network.
mathjax_path = "mathjax.js"
mathjax3_config = {"svg": {"fontCache": "global"}, "options": {"enableMenu": False}}

WITH_CONTENTS = ("development/**", "guide/**", "reference/**", "theory/**", "validation/**", "install", "quickstart")
html_theme = "pydata_sphinx_theme"
html_title = "magloc"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["copy.js"]
html_copy_source = False
html_show_sourcelink = False
html_sidebars = {"index": [], "install": [], "quickstart": [], "glossary": []}
html_theme_options = {
    "logo": {"text": "magloc"},
    "header_links_before_dropdown": 7,
    "navbar_start": ["navbar-logo", "release"],
    "navbar_end": ["theme-switcher"],
    "footer_start": ["copyright"],
    "footer_end": ["release"],
    # All but notebooks, whose lines take its width.
    "secondary_sidebar_items": {part: ["page-toc"] for part in WITH_CONTENTS},
    "show_prev_next": True,
    "show_toc_level": 2,
}
