"""The search of the values that all filters of GPB share, and tracks drawn from its own model."""
