"""Adaptation: fading factors, which widen a prediction whose motion no longer holds, and noise estimates."""

from torchfra.adaptive.fading import Fading, Memory
from torchfra.adaptive.noise import NoiseMemory, SageHusa

__all__ = ["Fading", "Memory", "NoiseMemory", "SageHusa"]
