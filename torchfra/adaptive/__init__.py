"""The prediction side: fading factors where the motion no longer holds; and estimates of the measurement noise."""

from torchfra.adaptive.fading import Fading, Memory, NoFading
from torchfra.adaptive.noise import NoiseMemory, NominalNoise, SageHusa

__all__ = ["Fading", "Memory", "NoFading", "NoiseMemory", "NominalNoise", "SageHusa"]
