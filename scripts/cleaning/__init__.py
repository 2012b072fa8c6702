"""The parts of ``clean_check.py``: truths, what is measured of them, figures, bounds, and what is shown of them."""
