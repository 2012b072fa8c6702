"""The jobs of ``benchmark.py``, one module each."""
