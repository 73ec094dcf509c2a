"""The documentation as a site: `make docs`, offline, warnings are errors."""

import re

from docutils import nodes
from latex2mathml.converter import convert

import beamfit

project = "beamfit"
author = "The beamfit authors"
release = version = beamfit.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_click",
]
exclude_patterns = ["**.ipynb_checkpoints"]
html_theme = "furo"
html_title = f"beamfit {version}"
html_copy_source = False
html_show_copyright = False
html_static_path, html_css_files = ["_static"], ["site.css"]
html_extra_path = ["gtf_reproduction.html"]
html_math_renderer = "mathml"

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
# Types are words for people, "shape (outputs,)", not names to be linked.
napoleon_use_param = napoleon_use_rtype = False
default_role = "literal"


def _typeset(writer, node):
    """Write a formula as MathML, which browsers set by themselves: nothing is fetched."""
    display = "block" if isinstance(node, nodes.math_block) else "inline"
    writer.body.append(convert(node.astext(), display=display))
    raise nodes.SkipNode


def _plain(app, context, lines):
    """Keep help texts as they are: u_ is no link, and an option has two hyphens."""
    for i, line in enumerate(lines):
        if not line.startswith(".. "):
            line = re.sub(r"(\w)_(?!\w)", r"\1\\_", line)
            lines[i] = re.sub(r"(?<![\w`-])(--[a-z][\w-]*)", r"``\1``", line)


def setup(app):
    """Make formulas MathML, and help texts plain words."""
    for part in ("description", "options", "epilog"):
        app.connect(f"sphinx-click-process-{part}", _plain)
    app.add_html_math_renderer("mathml", (_typeset, None), (_typeset, None))
