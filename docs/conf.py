"""The documentation as a site: `make docs`, offline, warnings are errors."""

import beamfit

project = "beamfit"
author = "The beamfit authors"
release = version = beamfit.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["**.ipynb_checkpoints"]
html_theme = "furo"
html_title = f"beamfit {version}"
html_copy_source = False
html_show_copyright = False
html_static_path, html_css_files = ["_static"], ["site.css"]
html_extra_path = ["gtf_reproduction.html"]

myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "none"
# Types are words for people, "shape (outputs,)", not names to be linked.
napoleon_use_param = napoleon_use_rtype = False
default_role = "literal"
