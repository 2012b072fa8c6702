"""The engine of a filter that answers by other means while its kernels are compiled."""

from __future__ import annotations

import threading
from collections.abc import Hashable
from concurrent.futures import Future
from typing import Any

import torch
from torch import Tensor

from torchfra.compiler.engine import Compiled
from torchfra.compiler.run import has_gradient


class Meanwhile:
    """Runs a call of a new form interpreted, while a thread makes its kernels; later calls of that form run compiled.

    The thread makes the same call, on copies of what it is given.  A call with gradients waits for its kernels.

    Args:
        otherwise: the engine that answers meanwhile, and runs what kernels do not take.
    """

    def __init__(self, otherwise: Any) -> None:
        self.otherwise, self._compiled = otherwise, Compiled(otherwise)
        self.call, self.calls = self._compiled.call, self._compiled.calls
        self._made: dict[Hashable, Future[Any]] = {}

    def __reduce__(self) -> tuple[type[Meanwhile], tuple[Any]]:
        return Meanwhile, (self.otherwise,)  # kernels are no part of a copy

    def another(self) -> Meanwhile:
        """An engine of the same kind for another filter: kernels are of one."""
        return Meanwhile(self.otherwise)

    def step(self, f: Any, *given: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("step", f, given)

    def once(self, f: Any, *given: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("once", f, given)

    def scan(self, f: Any, *given: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("scan", f, given)

    def forward(self, f: Any, *given: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("forward", f, given)

    def backward(self, f: Any, *given: Any) -> Any:
        """See ``filters.engine.Engine``."""
        return self._call("backward", f, given)

    def _call(self, name: str, f: Any, given: tuple[Any, ...]) -> Any:
        """What the method of this name gives.

        Raises:
            CompileError, NotImplementedError: kernels for an earlier call like this one could not be made.
        """
        tensors = [*f.parameters(), *_tensors(given)]
        if has_gradient(tensors) or not all(Compiled.takes(x) for x in tensors if x.is_floating_point()):
            return getattr(self._compiled, name)(f, *given)
        form = name, torch.is_grad_enabled(), torch.is_inference_mode_enabled(), _form(given)
        made = self._made.get(form)
        if made is None:
            made = self._made[form] = self._start(name, f, _copied(given))
        if not made.done():
            return getattr(self.otherwise, name)(f, *given)
        made.result()
        return getattr(self._compiled, name)(f, *given)

    def _start(self, name: str, f: Any, given: tuple[Any, ...]) -> Future[Any]:
        """Makes a call in a thread, which nobody waits for when the process ends."""
        made: Future[Any] = Future()
        inference, grad = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

        def work() -> None:
            try:
                with torch.inference_mode(inference), torch.set_grad_enabled(grad):  # which hold for each thread alone
                    getattr(self._compiled, name)(f, *given)
            except BaseException as error:
                made.set_exception(error)
            else:
                made.set_result(None)

        threading.Thread(target=work, daemon=True).start()
        return made


def _tensors(given: Any) -> list[Tensor]:
    if isinstance(given, Tensor):
        return [given]
    return [x for part in given for x in _tensors(part)] if isinstance(given, tuple | list) else []


def _copied(given: Any) -> Any:
    """The same with tensors that nobody else changes."""
    if isinstance(given, Tensor):
        return given.clone()
    if isinstance(given, tuple | list):
        parts = map(_copied, given)
        return type(given)(*parts) if hasattr(given, "_fields") else type(given)(parts)
    return given


def _form(given: Any) -> Hashable:
    """What kernels depend on; of numbers and tensors not the values."""
    if isinstance(given, Tensor):
        return given.dtype, given.device, given.dim(), given.dim() == 0 or given.shape[:-1].numel() == 1
    if isinstance(given, tuple | list):
        return type(given), tuple(map(_form, given))
    if given is None or isinstance(given, bool) or callable(given):
        itself: Hashable = given
        return itself
    return str(type(given))
