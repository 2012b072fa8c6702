"""The cells of ``regret.py``, their ratios, and what is shown of them, one module each."""
