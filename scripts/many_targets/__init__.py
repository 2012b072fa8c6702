"""What ``scripts/targets.py`` runs: worlds with many targets, what became of them, and a picture."""
