"""Cleaned tracks as tables of pandas."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from torchfra.cleaning import Cleaned
from torchfra.cleaning.outputs.table import columns, united


def table(cleaned: Cleaned | Sequence[Cleaned]) -> pd.DataFrame:
    """Cleaned tracks as a table: a row for each estimate, the columns of ``torchfra track --out``."""
    several = [cleaned] if isinstance(cleaned, Cleaned) else list(cleaned)
    return pd.DataFrame(united([columns(one) for one in several]))
