"""Figures for the gallery that are no windows of pyplot: what ``.plot()`` of a record gives back."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


def returned_figures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figure that the last line of a block is; sphinx-gallery keeps that value as ``___``."""
    value = block_vars["example_globals"].get("___")
    if not isinstance(value, Figure) or value.canvas.manager is not None:  # pyplot's own are scraped as windows
        return ""
    path = next(block_vars["image_path_iterator"])
    value.savefig(path, dpi=110)
    return str(figure_rst([path], gallery_conf["src_dir"]))
