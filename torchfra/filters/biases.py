"""An unobservable constant bias of the sensor (consider parameter): it is not estimated, but covariances contain it."""

from __future__ import annotations

import math
from typing import TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.base import Filter
from torchfra.hyper import Value
from torchfra.linalg.triangular import hstack, tria
from torchfra.numbers import as_numbers
from torchfra.types import Estimate, Failure, Gaussian

E = TypeVar("E", Estimate, Gaussian)


def biased_copies(z: Tensor, std: Value) -> Tensor:
    """Measurements, and a copy of them for each element, to which the standard deviation of its bias is added.

    A filter takes the copies as a batch, and ``considered`` makes one estimate of theirs::

        copies = biased_copies(z, std=4.0)
        estimate = considered(f, f(copies, prior))
        smoothed = considered(f, f.smooth(copies, prior))

    In a stream they are ``z (1 + m, m)`` of ``step``, and ``considered(f, state.belief)`` is the estimate.

    Args:
        z: ``(..., m)``; NaN is missing.
        std: standard deviation of the bias, in units of the measurement: a number, or ``(m,)`` one for each element.

    Returns:
        ``(1 + m, ..., m)``.

    Raises:
        ValueError: a standard deviation below 0 or not finite, or another shape.
    """
    m, given = z.shape[-1], as_numbers(std, "std")
    if given.shape not in ((), (m,)):
        raise ValueError(f"std: expected a number or ({m},), received {tuple(given.shape)}")
    if not bool(((given >= 0) & (given < math.inf)).all()):
        raise ValueError(f"std: expected finite values of 0 or more, received {given.tolist()}")
    each = torch.diag(given.to(z).expand(m))
    shifts = torch.cat([torch.zeros_like(each[:1]), each])
    return z + shifts.reshape(1 + m, *(1,) * (z.dim() - 1), m)


def considered(f: Filter, copies: E) -> E:
    """The estimate of measurements with a bias that is considered: mean as without it, covariance with it.

    A bias that is constant over a track, such as the metres by which satellite positions of a day are off, is a shift
    that no filter can distinguish from the target's position.  With the slope ``S`` of the estimate in the bias, and
    its covariance ``B``, the error of the estimate has the covariance ``P + S B S^T``.  The estimates of biased copies
    give the columns of ``S B^1/2``.  For a linear filter this is exact; for others ``S`` is the change by one standard
    deviation.

    Args:
        f: the filter.
        copies: its estimates of ``biased_copies`` (whole tracks, filtered or smoothed), or such a belief.

    Returns:
        The estimate without the dimension of copies.  ``scale_tril`` contains the bias, ``failure`` the copies that
        failed; all else is the estimate from the unbiased measurements.  So ``filters.protection_level`` does not
        contain the bias: state it as ``fault``.

    Raises:
        ValueError: another number of copies than one more than the sensor of the filter has elements.

    Source: Bierman (1977), "Factorization Methods for Discrete Sequential Estimation", chapter VIII; Tapley, Schutz &
    Born (2004), "Statistical Orbit Determination", chapter 6.  Differs: slopes are differences of estimates.  The
    filter of Schmidt (1966) has the bias in its gains too.
    """
    count, whole = 1 + f.sensor.size, isinstance(copies, Estimate)
    if copies.mean.dim() < 2 + whole or len(copies.mean) != count:
        received = tuple(copies.mean.shape)
        raise ValueError(f"copies: expected the {count} of biased measurements in front, received {received}")
    slope = f.motion.difference(copies.mean[1:], copies.mean[:1]).movedim(0, -1)
    one: E = tree.map_tensors(lambda x: x[0], copies)
    if isinstance(copies, Estimate) and copies.failure is not None:
        which = copies.failure.step.argmax(0, keepdim=True)  # a copy that failed, if one did
        step, cause = (x.gather(0, which)[0] for x in copies.failure[:2])
        one = one._replace(failure=Failure(step, cause, copies.failure.values))
    return one._replace(scale_tril=tria(hstack(one.scale_tril, slope)))
