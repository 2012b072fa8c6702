"""Filters of scans: several targets, and unassociated measurements."""
