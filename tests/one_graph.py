"""Which torch compiles a filter as one graph."""

import pytest
import torch

ONE_GRAPH = torch.__version__ >= (2, 11)
"""Older ones break the graph at methods of named tuples, and at functions with a gradient of their own; what comes out
is the same."""
needs_one_graph = pytest.mark.skipif(not ONE_GRAPH, reason="torch.compile makes one graph of a filter from 2.11 on")
