"""Recordings with a truth and published figures: how they are read, with which models, and what came out."""
