"""Dates of two digits are read in the order by which they go on from row to row; where several do, they are refused."""

from __future__ import annotations
