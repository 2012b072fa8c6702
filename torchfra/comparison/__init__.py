"""Filters compared as a paper would: errors with intervals, paired tests, the bound, a table and a figure."""

from torchfra.comparison.comparison import Comparison, compare

__all__ = ["Comparison", "compare"]
