"""Names and kinds of the components of a state."""

from __future__ import annotations

from collections.abc import Sequence

KINDS = ("position", "velocity", "acceleration", "angle", "rate", "bias", "clock", "parameter", "other")
"""Kinds of components; a rate is that of an angle, rad/s; a parameter is a property of the target, such as its drag."""
AXES = ("x", "y", "z")


def usual(
    size: int, dims: int, orders: int, position: slice, velocity: slice, angles: Sequence[int]
) -> tuple[list[str], list[str]]:
    """Names and kinds by the layout of a state: ``x y vx vy ax ay``, and the index of any other component."""
    names, kinds = [f"state {i}" for i in range(size)], ["other"] * size
    parts = [("position", "", position), ("velocity", "v", velocity)]
    if orders > 2 and (position, velocity) == (slice(0, dims), slice(dims, 2 * dims)):
        parts.append(("acceleration", "a", slice(2 * dims, 3 * dims)))
    for kind, letter, where in parts:
        for axis, i in enumerate(range(size)[where]):
            names[i], kinds[i] = letter + axis_name(axis, dims), kind
    for i in angles:
        names[i], kinds[i] = names[i] if kinds[i] != "other" else f"angle {i}", "angle"
    return names, kinds


def axis_name(axis: int, dims: int) -> str:
    """``x``, ``y`` or ``z``; a number in a space of more dimensions."""
    return AXES[axis] if dims <= len(AXES) else f"x{axis}"


def check_components(size: int, names: Sequence[str], kinds: Sequence[str]) -> None:
    """Checks the names and kinds of a state's components.

    Raises:
        ValueError: not one for each component, a name twice, or an unknown kind.
    """
    for argument, values in (("components", names), ("kinds", kinds)):
        if len(values) != size:
            raise ValueError(f"{argument}: expected one for each of {size} components, received {list(values)}")
    if len(set(names)) < size:
        raise ValueError(f"components: expected different names, received {list(names)}")
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, received {unknown[0]!r}")
