"""Filters beside a network that learns the gain, on the attractor of Lorenz: models, the network, settings."""
