"""Soft choices: the temperature of filters that decide."""

from __future__ import annotations

from torchfra.numbers import as_number


class Soft:
    """Mixed into a filter: a ``temperature``, 0 for hard choices and above for soft ones, to train by."""

    annealed: tuple[str, ...] = ("_temperature",)
    _temperature: float
    soft: bool

    @property
    def temperature(self) -> float:
        """0 for hard choices, above for soft ones."""
        return self._temperature

    @temperature.setter
    def temperature(self, value: float) -> None:
        if not as_number(value) >= 0:
            raise ValueError(f"temperature: expected 0 or more, received {value!r}")
        self._temperature, self.soft = float(value), value > 0
