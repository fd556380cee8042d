"""The site of rgs_mi's documentation: `sphinx-build -W docs docs/_build`, in an environment that has the package."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import rgs_mi  # noqa: E402

rgs_mi.set_variant("llvm_ad_rgb")  # the plugins' classes, and so autodoc, need a variant

project, author = "rgs_mi", "the rgs_mi authors"
copyright = "2026, the rgs_mi authors"
version = release = rgs_mi.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "api_pages", "plugin_pages", "settings_table"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"rgs_mi {version}"

nb_execution_mode = "off"  # tests/test_notebook.py runs it; what it shows is of the helmet's nine minutes
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

default_role = "py:obj"  # what single backticks name in docstrings
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
napoleon_use_ivar = True  # attributes are also members
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # docstrings also name what is Mitsuba's, NumPy's or private
