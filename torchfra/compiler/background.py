"""The engine of a filter that answers by other means while its kernels are compiled."""

from __future__ import annotations

from collections.abc import Hashable
from concurrent.futures import Future
from functools import partialmethod
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.engine import Compiled
from torchfra.compiler.program import Making
from torchfra.compiler.run import has_gradient
from torchfra.tree import flatten, map_tensors


class InBackground:
    """Runs a call of a new form interpreted, while a thread makes its kernels; later calls of that form run compiled.

    The thread makes the same call, on copies of its arguments.  A call with gradients waits for its kernels.

    Args:
        otherwise: the engine that answers meanwhile, and runs what kernels do not take.
    """

    def __init__(self, otherwise: Any) -> None:
        self.otherwise, self._compiled = otherwise, Compiled(otherwise)
        self.call, self.calls = self._compiled.call, self._compiled.calls
        self._made: dict[Hashable, Future[Any]] = {}

    def __reduce__(self) -> tuple[type[InBackground], tuple[Any]]:
        return InBackground, (self.otherwise,)  # kernels are no part of a copy

    def another(self) -> InBackground:
        """An engine of the same kind for another filter: kernels are of one."""
        return InBackground(self.otherwise)

    def _run(self, name: str, f: Any, *arguments: Any) -> Any:
        """The result of the method of this name; see ``filters.engine.Engine``.

        Raises:
            CompileError, NotImplementedError: kernels for an earlier call like this one could not be made.
        """
        tensors = [*f.parameters(), *flatten(arguments)]
        if has_gradient(tensors) or not all(Compiled.takes(x) for x in tensors if x.is_floating_point()):
            return getattr(self._compiled, name)(f, *arguments)
        form = name, torch.is_grad_enabled(), torch.is_inference_mode_enabled(), _form(arguments)
        made = self._made.get(form)
        if made is None:
            made = self._made[form] = self._start(name, f, map_tensors(Tensor.clone, arguments))
        if not made.done():
            return getattr(self.otherwise, name)(f, *arguments)
        made.result()
        return getattr(self._compiled, name)(f, *arguments)

    step, once = partialmethod(_run, "step"), partialmethod(_run, "once")
    over_steps = partialmethod(_run, "over_steps")
    forward, backward = partialmethod(_run, "forward"), partialmethod(_run, "backward")

    def _start(self, name: str, f: Any, arguments: tuple[Any, ...]) -> Future[Any]:
        """Makes a call in a thread."""
        made: Future[Any] = Future()
        inference, grad = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

        def work() -> None:
            try:
                with torch.inference_mode(inference), torch.set_grad_enabled(grad):  # which hold for each thread alone
                    getattr(self._compiled, name)(f, *arguments)
            except BaseException as error:
                made.set_exception(error)
            else:
                made.set_result(None)

        Making(target=work).start()
        return made


def _form(x: Any) -> Hashable:
    """What kernels depend on; of numbers and tensors not the values."""
    if isinstance(x, Tensor):
        return x.dtype, x.device, x.dim(), x.dim() == 0 or x.shape[:-1].numel() == 1
    if isinstance(x, tuple):
        return type(x), tuple(map(_form, x))
    if x is None or isinstance(x, bool) or callable(x):
        itself: Hashable = x
        return itself
    return str(type(x))
