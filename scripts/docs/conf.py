"""How Sphinx builds the documentation: ``bash scripts/docs.sh``."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from builder import programs  # noqa: E402

from torchfra.version import __version__  # noqa: E402

project, author, release = "torchfra", "The torchfra developers", __version__
copyright = f"{author}, MIT licence"
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_gallery.gen_gallery",
    "sphinx_copybutton",
    "builder",
]

html_theme = "furo"
html_title = f"torchfra {release}"
html_static_path = ["static"]
html_css_files = ["style.css"]
html_math_renderer = "mathml"
html_show_sphinx = False
pygments_style, pygments_dark_style = "tango", "github-dark"
copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_custom_sections = [("Differs", "params_style")]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
autodoc_inherit_docstrings = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
nitpicky = False

sphinx_gallery_conf = {
    "examples_dirs": [
        programs(ROOT / "scripts" / "docs" / "gallery", "Pictures", "Short programs, each with what it draws."),
        programs(ROOT / "scripts" / "examples", "Examples", "To be read from top to bottom, with what they print."),
    ],
    "gallery_dirs": ["gallery/pictures", "gallery/examples"],
    "filename_pattern": r"/(plot_|0)\w*\.py$",  # what takes minutes, or more than the extra, is shown and not run
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("builder.scraper", "matplotlib"),  # the second one closes what it has drawn
    "capture_repr": (),
    "reset_argv": "builder.arguments",
    "reset_modules": ("matplotlib",),
    "abort_on_example_error": True,
    "plot_gallery": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "nested_sections": False,
    "write_computation_times": False,
}
