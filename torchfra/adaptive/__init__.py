"""Adaptation: fading factors, which widen a prediction whose motion no longer holds, and noise estimates."""

from torchfra.adaptive.fading import Fading, Memory, NoFading
from torchfra.adaptive.noise import NoiseMemory, NominalNoise, SageHusa

__all__ = ["Fading", "Memory", "NoFading", "NoiseMemory", "NominalNoise", "SageHusa"]
