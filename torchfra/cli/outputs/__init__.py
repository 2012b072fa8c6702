"""What ``torchfra track`` gives back: tables, tracks for maps, what belongs to them, and a line for people."""

from torchfra.cli.outputs.formats import FORMATS, MAPS, check_format, write
from torchfra.cli.outputs.metadata import metadata
from torchfra.cli.outputs.summary import line, settings_line, summary
from torchfra.cli.outputs.table import columns

__all__ = ["FORMATS", "MAPS", "check_format", "columns", "line", "metadata", "settings_line", "summary", "write"]
