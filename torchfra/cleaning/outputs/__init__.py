"""What ``torchfra track`` gives back: tables, tracks for maps, what belongs to them, and a line for people."""

from torchfra.cleaning.outputs.formats import FORMATS, MAPS, check_format, write
from torchfra.cleaning.outputs.metadata import metadata
from torchfra.cleaning.outputs.summary import line, settings_line, summary
from torchfra.cleaning.outputs.table import columns

__all__ = ["FORMATS", "MAPS", "check_format", "columns", "line", "metadata", "settings_line", "summary", "write"]
