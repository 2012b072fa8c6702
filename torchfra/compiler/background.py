"""The engine of a filter that answers by other means while its kernels are compiled."""

from __future__ import annotations

from collections.abc import Hashable
from concurrent.futures import Future
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.engine import Compiled
from torchfra.compiler.program import Making
from torchfra.compiler.run import has_gradient


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

    def step(self, f: Any, *arguments: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("step", f, arguments)

    def once(self, f: Any, *arguments: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("once", f, arguments)

    def over_steps(self, f: Any, *arguments: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("scan", f, arguments)

    def forward(self, f: Any, *arguments: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("forward", f, arguments)

    def backward(self, f: Any, *arguments: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("backward", f, arguments)

    def _call(self, name: str, f: Any, arguments: tuple[Any, ...]) -> Any:
        """What the method of this name gives.

        Raises:
            CompileError, NotImplementedError: kernels for an earlier call like this one could not be made.
        """
        tensors = [*f.parameters(), *_tensors(arguments)]
        if has_gradient(tensors) or not all(Compiled.takes(x) for x in tensors if x.is_floating_point()):
            return getattr(self._compiled, name)(f, *arguments)
        form = name, torch.is_grad_enabled(), torch.is_inference_mode_enabled(), _form(arguments)
        made = self._made.get(form)
        if made is None:
            made = self._made[form] = self._start(name, f, _copied(arguments))
        if not made.done():
            return getattr(self.otherwise, name)(f, *arguments)
        made.result()
        return getattr(self._compiled, name)(f, *arguments)

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


def _tensors(x: Any) -> list[Tensor]:
    if isinstance(x, Tensor):
        return [x]
    return [leaf for part in x for leaf in _tensors(part)] if isinstance(x, tuple | list) else []


def _copied(x: Any) -> Any:
    """The same with tensors that nobody else changes."""
    if isinstance(x, Tensor):
        return x.clone()
    if isinstance(x, tuple | list):
        parts = map(_copied, x)
        return type(x)(*parts) if hasattr(x, "_fields") else type(x)(parts)
    return x


def _form(x: Any) -> Hashable:
    """What kernels depend on; of numbers and tensors not the values."""
    if isinstance(x, Tensor):
        return x.dtype, x.device, x.dim(), x.dim() == 0 or x.shape[:-1].numel() == 1
    if isinstance(x, tuple | list):
        return type(x), tuple(map(_form, x))
    if x is None or isinstance(x, bool) or callable(x):
        itself: Hashable = x
        return itself
    return str(type(x))
