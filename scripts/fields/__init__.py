"""Jobs and peers of scripts/field.py."""
