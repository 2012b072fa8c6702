"""The filters that papers name, ready made: each is a choice of arguments.

``learn`` names the hyperparameters that gradient descent may change, wherever in the filter they are: ``threshold``,
``low``, ``high``, ``weakening``, ``forgetting``, ``fading_max``, ``share``, ``gate``, ``preference``, of interacting
models ``transition`` and ``initial``, of an estimate of the noise ``forgetting`` and ``confidence``, of scans
``detection``, ``gate.size``, ``probability``, ``volume`` and ``rate``, and of motions and sensors ``q``, ``std``,
``rate``, ``alpha``, ``limit``; or ``"all"``.  A model that learns is copied first: what is handed in stays as it is.

``per_element=True`` gives each element of a measurement a threshold of its own; ``share=(1, 0.1, 0.1)`` fades position,
velocity and acceleration, each by its share (``states`` makes other groups).  Further keywords go to ``Fading``
(``weakening``, ``forgetting``, ``fading_max``, ``rcond``, ``states``, ``share``, ``trace``) or, for the FRA filters,
``gate``, ``preference``, ``decision``, ``temperature``, ``memory``, ``final`` and ``rule`` to ``FRA``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeVar

import torch

from torchfra.adaptive.fading import Fading
from torchfra.adaptive.noise import SageHusa
from torchfra.association.clutter import Clutter
from torchfra.association.gates import ChiSquare, Euclidean, Gate
from torchfra.filters.alphabeta.bank import AlphaBetaBank
from torchfra.filters.base import Filter
from torchfra.filters.fra import FRA
from torchfra.filters.imm import IMM, Around
from torchfra.filters.jpda import JPDA
from torchfra.filters.srckf import SRCKF
from torchfra.filters.vsimm import VSIMM
from torchfra.gaussian.cubature import fifth_degree, tangent, unscented
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value, learnable, named
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.robust.regression import HuberRegression
from torchfra.robust.score import HuberScore
from torchfra.robust.weights import Huber, ThreeSegment
from torchfra.sensors.base import Sensor

Names = Collection[str]
Models = Sequence[Motion] | Bank
F = TypeVar("F", bound=Filter)
_FADING = ("weakening", "forgetting", "fading_max", "rcond", "states", "share", "trace")


def ekf(motion: Motion, sensor: Sensor, *, learn: Names = ()) -> SRCKF:
    """Extended Kalman filter.  Source: Jazwinski (1970), ch. 8."""
    return _learning(SRCKF(motion, sensor, rule=tangent), learn)


def ukf(motion: Motion, sensor: Sensor, *, learn: Names = (), **scaling: float) -> SRCKF:
    """Unscented Kalman filter; ``scaling``: ``alpha=1, beta=0, kappa=1``.  Source: Julier & Uhlmann (2004)."""
    return _learning(SRCKF(motion, sensor, rule=unscented(**scaling)), learn)


def srckf(motion: Motion, sensor: Sensor, *, learn: Names = ()) -> SRCKF:
    """Square-root cubature Kalman filter.  Source: Arasaratnam & Haykin (2009)."""
    return _learning(SRCKF(motion, sensor), learn)


def rsrckf(
    motion: Motion, sensor: Sensor, *, threshold: Value = 1.345, per_element: bool = False, learn: Names = ()
) -> SRCKF:
    """Robust: Huber weights at every step.  Source: Wang et al. (2021), eqs. (25)-(26)."""
    return _learning(SRCKF(motion, sensor, robust=_huber(sensor, threshold, per_element)), learn)


def mr_ckf(motion: Motion, sensor: Sensor, *, learn: Names = (), **segments: Any) -> SRCKF:
    """Robust: one three-segment weight at every step.  Source: Wu et al. (2015), as read in ``ThreeSegment``."""
    return _learning(SRCKF(motion, sensor, robust=ThreeSegment(**segments)), learn)


def asrckf(motion: Motion, sensor: Sensor, *, learn: Names = (), **fading: Any) -> SRCKF:
    """Adaptive: fading factors at every step.  Source: Wang et al. (2021), eqs. (29)-(34)."""
    return _learning(SRCKF(motion, sensor, fading=_fading(motion, fading)), learn)


def rmckf(
    motion: Motion,
    sensor: Sensor,
    *,
    threshold: Value = 1.345,
    per_element: bool = False,
    learn: Names = (),
    **fading: Any,
) -> SRCKF:
    """Robust and adaptive at every step.  Source: Qiu, Qian & Wang (2018), as Wang et al. (2021) describe it."""
    robust = _huber(sensor, threshold, per_element)
    return _learning(SRCKF(motion, sensor, robust=robust, fading=_fading(motion, fading)), learn)


def ghckf(motion: Motion, sensor: Sensor, *, learn: Names = ()) -> SRCKF:
    """Fifth-degree cubature Kalman filter.  Source: Zhang (2014); Qin et al. (2018), eqs. (48)-(52)."""
    return _learning(SRCKF(motion, sensor, rule=fifth_degree), learn)


def hghckf1(
    motion: Motion,
    sensor: Sensor,
    *,
    rule: Callable[[int], Rule] = fifth_degree,
    learn: Names = (),
    **regression: Any,
) -> SRCKF:
    """Robust by regression: ``threshold, max_iter, tol, first_iterate, compensate`` as in ``HuberRegression``.

    Source: Zhang et al. (2016), what Qin et al. (2018) compare with.
    """
    return _learning(SRCKF(motion, sensor, rule=rule, robust=HuberRegression(**regression)), learn)


def hghckf2(
    motion: Motion,
    sensor: Sensor,
    *,
    rule: Callable[[int], Rule] = fifth_degree,
    learn: Names = (),
    **score: Any,
) -> SRCKF:
    """Robust by the score: ``threshold, eps, cov_mode, whitening, zeta_scale`` as in ``HuberScore``.

    Source: Qin et al. (2018), eqs. (53)-(59).
    """
    return _learning(SRCKF(motion, sensor, rule=rule, robust=HuberScore(**score)), learn)


def iaukf(
    motion: Motion,
    sensor: Sensor,
    *,
    learn: Names = (),
    **noise: Any,
) -> SRCKF:
    """Unscented filter that estimates the variance of the measurement noise, sensor by sensor.

    ``noise``: ``forgetting, confidence, confidence_in, lowest, highest, warmup, adapt`` as in ``SageHusa``.

    Source: Chen, Zou & Wu, eqs. (10)-(24), with ``alpha=1, kappa=0`` and their psi of 2.  Differs: the points of the
    measurement are drawn anew from the prediction, process noise included (errors 0.1 to 0.9 % smaller).
    """
    side = SageHusa(sensor.blocks, **noise)
    return _learning(SRCKF(motion, sensor, rule=unscented(1.0, 2.0, 0.0), noise=side), learn)


def fra_srckf(
    motion: Motion,
    sensor: Sensor,
    *,
    threshold: Value = 1.345,
    per_element: bool = False,
    learn: Names = (),
    **options: Any,
) -> FRA:
    """Robust or adaptive at abnormal steps, as the next measurement decides.  Source: Wang et al. (2021), section 2.2.

    ``rcond=0, fading_max=inf`` are the paper's own formulas, which may diverge; the defaults 0.1 and 1000 do not.
    """
    fading = {name: options.pop(name) for name in _FADING if name in options}
    robust = _huber(sensor, threshold, per_element)
    return _learning(FRA(motion, sensor, robust=robust, fading=_fading(motion, fading), **options), learn)


def fra(motion: Motion, sensor: Sensor, **options: Any) -> FRA:
    """Ours: ``fra_srckf`` that decides by predictive likelihood, and remembers innovations by their robust weights."""
    ours: dict[str, Any] = {"decision": "likelihood", "memory": "weighted", "rcond": 0.2}
    return fra_srckf(motion, sensor, **ours | options)


def imm(
    models: Models,
    sensor: Sensor,
    *,
    inner: Callable[..., Filter] = srckf,
    stay: float = 0.95,
    transition: Value | None = None,
    initial: Value | None = None,
    learn: Names = (),
    **options: Any,
) -> IMM:
    """Interacting multiple models: ``inner`` is any preset of this file for one model, ``options`` go to it.

    ``models`` are motions of one state, or a ``Bank`` of them.  ``stay`` is the probability to stay with a model, the
    others share what is left; ``transition`` (K, K) says it in full.

    Source: Blom & Bar-Shalom (1988); Du & Zhang (2020) for the square-root cubature form.
    """
    bank = _bank(models)
    matrix = _transition(len(bank), stay, transition)
    f = IMM(inner(bank, sensor, **options), transition=matrix, initial=initial)
    return _learning(f, learn)


def imm_srckf(models: Models, sensor: Sensor, **options: Any) -> IMM:
    """``imm`` with ``srckf`` for each model.  Source: Du & Zhang (2020)."""
    return imm(models, sensor, inner=srckf, **options)


def imm_ckf(models: Models, sensor: Sensor, **options: Any) -> IMM:
    """What Du & Zhang (2020) compare with: the same filter as ``imm_srckf``, under their name.

    A covariance or its root is a matter of rounding alone: the difference in accuracy that they report cannot come from
    it.  It is computed with roots here too.
    """
    return imm_srckf(models, sensor, **options)


def imm_fra(models: Models, sensor: Sensor, **options: Any) -> IMM:
    """``imm`` with ``fra`` for each model: for targets that turn under sensors that lie.

    ``preference`` is 5 unless given: the bank explains manoeuvres, so that an abnormal step is an outlier sooner; and
    ``stay`` is 0.99, so that one outlier does not change the model.
    """
    return imm(models, sensor, inner=fra, **{"preference": 5.0, "stay": 0.99} | options)


def vsimm_srckf(
    models: Models,
    sensor: Sensor,
    *,
    inner: Callable[..., Filter] = srckf,
    neighbours: Sequence[Sequence[int]] | None = None,
    first: Sequence[int] | None = None,
    stay: float = 0.95,
    transition: Value | None = None,
    unlikely: Value = 0.05,
    principal: Value = 0.5,
    learn: Names = (),
    **options: Any,
) -> VSIMM:
    """Interacting models of which a few run at a time: three of five in the paper.  Source: Du & Zhang (2020).

    ``stay`` and ``transition`` as in ``imm``; ``neighbours`` and ``first`` are those of the ``Bank`` unless given (the
    paper prints none; ours are in ``scenarios.adsb_models``); ``options`` go to ``inner``.
    """
    bank = _bank(models)
    neighbours = bank.neighbours if neighbours is None else neighbours
    first = bank.first if first is None else first
    if neighbours is None or first is None:
        raise ValueError("neighbours, first: expected both, or a Bank that has them, received none")
    f = VSIMM(
        inner(bank, sensor, **options),
        neighbours=neighbours,
        first=first,
        transition=_transition(len(bank), stay, transition),
        unlikely=unlikely,
        principal=principal,
    )
    return _learning(f, learn)


def _bank(models: Models) -> Bank:
    if isinstance(models, Motion) and not isinstance(models, Bank):
        raise ValueError(f"models: expected several motions or a Bank, received {type(models).__name__}")
    return models if isinstance(models, Bank) else Bank(models)


def _transition(count: int, stay: float, transition: Value | None) -> Value:
    """A matrix that was given, or the one in which all others share what ``stay`` leaves."""
    if not 0 < stay < 1:
        raise ValueError(f"stay: expected a probability above 0 and below 1, received {stay}")
    if transition is not None:
        return transition
    eye = torch.eye(count, dtype=torch.float64)
    return stay * eye + (1 - stay) / (count - 1) * (1 - eye) if count > 1 else eye


def jpda(
    motion: Motion,
    sensor: Sensor,
    *,
    clutter: Clutter,
    inner: Callable[..., SRCKF] = srckf,
    gate: Gate | None = None,
    detection: Value = 0.95,
    lost: float = 0.0,
    share_noise: bool = False,
    exact: tuple[int, int] = (4, 10),
    temperature: float = 0.0,
    learn: Names = (),
    **options: Any,
) -> JPDA:
    """Several targets in scans with false measurements: ``inner`` is a preset of this file, ``options`` go to it.

    The gate holds 99.9 % of the targets' measurements unless given.  ``gate``, ``clutter``, ``detection`` and the
    others as in ``filters.JPDA``.

    Source: Fortmann, Bar-Shalom & Scheffe (1983).
    """
    f = JPDA(
        inner(motion, sensor, **options),
        gate=ChiSquare() if gate is None else gate,
        clutter=clutter,
        detection=detection,
        lost=lost,
        share_noise=share_noise,
        exact=exact,
        temperature=temperature,
    )
    return _learning(f, learn)


def ukf_jpda(motion: Motion, sensor: Sensor, *, clutter: Clutter, **options: Any) -> JPDA:
    """``jpda`` with the unscented filter of ``iaukf`` under constant noise, in a gate of 100 m.

    ``gate=Euclidean(100.0, least=0.9999), lost=1e-3`` are the safeguards of ``iaukf_jpda``.

    Source: what Chen, Zou & Wu compare with.
    """
    ours: dict[str, Any] = {"gate": Euclidean(100.0), "alpha": 1.0, "beta": 2.0, "kappa": 0.0}
    return jpda(motion, sensor, clutter=clutter, inner=ukf, **ours | options)


def iaukf_jpda(motion: Motion, sensor: Sensor, *, clutter: Clutter, **options: Any) -> JPDA:
    """``jpda`` with ``iaukf`` for each target, in a gate of 100 m.

    Source: Chen, Zou & Wu.  Differs: the gate is never smaller than what a target's own measurement needs, and a track
    that is missed again and again searches.  ``gate=Euclidean(100.0), lost=0.0`` leave both out: then a start more than
    a gate off, or a false measurement in the place of a missed target, loses the track for good in 1 to 5 % of the
    runs.
    """
    ours: dict[str, Any] = {"gate": Euclidean(100.0, least=0.9999), "lost": 1e-3}
    return jpda(motion, sensor, clutter=clutter, inner=iaukf, **ours | options)


_BANK: dict[str, Any] = {
    "manoeuvre": 3.5, "outlier": 18.0, "margin": 6.0, "hysteresis": 0.7, "dwell": 20.0, "degrees": [0.25],
    "onset": "fastest",
}  # fmt: skip


def alphabeta(motion: Motion, sensor: Sensor, *, learn: Names = (), **options: Any) -> AlphaBetaBank:
    """Alpha-beta filters that switch with the manoeuvre: the cheapest.  Source: Xu et al.; Kalata (1984) for the gains.

    With a motion of constant velocity it is the paper's; with constant acceleration the fast levels have three gains,
    which extrapolate a manoeuvre over outliers, and thresholds that were tuned on ``scenarios.level_then_weave``.
    ``options`` go to ``AlphaBetaBank``.
    """
    ours = _BANK if motion.orders == 3 and options.get("gains") is None else {}
    return _learning(AlphaBetaBank(motion, sensor, **ours | options), learn)


def _huber(sensor: Sensor, threshold: Value, per_element: bool) -> Huber:
    return Huber(threshold, elements=sensor.size if per_element else None)


def _fading(motion: Motion, options: dict[str, Any]) -> Fading:
    groups = [slice(i * motion.dims, (i + 1) * motion.dims) for i in range(motion.orders)]
    states = motion.position if options.get("share") is None else groups
    return Fading(**{"states": states} | options)


def _learning(f: F, names: Names) -> F:
    """The filter with these hyperparameters learnable, and those of its models in copies of its own."""
    core = f.inner if isinstance(f, Around | JPDA) else f
    for part in ("motion", "sensor"):
        model = getattr(core, part)
        chosen = {id(hyper) for hyper in named(f, names).values() if not hyper.raw.requires_grad}
        if any(id(hyper) in chosen for hyper in model.modules()):
            setattr(core, part, copy.deepcopy(model))
    return learnable(f, names)
