"""Outputs of ``torchfra track``: tables, tracks for maps, their metadata, and a summary in sentences."""

from torchfra.cleaning.outputs.formats import FORMATS, MAPS, check_format, write
from torchfra.cleaning.outputs.metadata import metadata
from torchfra.cleaning.outputs.summary import overview, report, summary
from torchfra.cleaning.outputs.table import columns

__all__ = [
    "FORMATS",
    "MAPS",
    "check_format",
    "columns",
    "metadata",
    "overview",
    "report",
    "summary",
    "write",
]
