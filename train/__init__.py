"""Recipes that learn a filter's hyperparameters; nothing in torchfra imports them."""
