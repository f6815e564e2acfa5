"""Sphinx configuration of the documentation; `make docs` builds it into docs/_build/html."""

import shutil
import sys
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE / "_ext"))

project = "thermorender"
copyright = "the thermorender authors"
release = version = version_of("thermorender")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "numpydoc", "command_line", "public_names"]
exclude_patterns = ["_build", "_ext"]
html_theme = "furo"
html_title = f"thermorender {release}"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_theme_options = {
    "source_repository": "",
    "light_css_variables": {"color-brand-primary": "#a63d00", "color-brand-content": "#a63d00"},
    "dark_css_variables": {"color-brand-primary": "#ffa566", "color-brand-content": "#ffa566"},
}

myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
# Progress and warnings of a notebook's libraries are not part of the page.
nb_output_stderr = "remove"

autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

# The notebooks live in examples/; Sphinx reads pages below docs/ only.
for notebook in sorted((ROOT / "examples").glob("*.ipynb")):
    shutil.copy(notebook, HERE / "examples" / notebook.name)
