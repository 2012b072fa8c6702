"""The prediction side: fading factors where the motion no longer holds; and estimates of the measurement noise."""

from torchfra.adaptive.fading import Fading, Memory
from torchfra.adaptive.noise import NoiseMemory, SageHusa

__all__ = [
    "Fading",
    "Memory",
    "NoiseMemory",
    "SageHusa",
]
