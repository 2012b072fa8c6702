"""Filters of scans: several targets, whose measurements do not say whose they are."""
