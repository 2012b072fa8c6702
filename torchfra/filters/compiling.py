"""Running as compiled kernels: the switch of a filter."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn
from typing_extensions import Self


class Compilable(nn.Module):
    """Abstract, a part of ``Filter``: what ``compile`` makes of it."""

    kernel_numbers: tuple[str, ...] = ()
    """Attributes that are plain numbers, which compiled kernels read when they run."""
    slow_to_compile = False  # some ten seconds or more: commands compile such a filter only when told to
    _kernels: Any

    def kernels_for(self, z: Tensor) -> Any:
        """What runs measurements ``z`` as kernels; None without ``compile``, and for what kernels do not take."""
        return self._kernels if self._kernels is not None and self._kernels.takes(z) else None

    def compile(self, *args: Any, **options: Any) -> Self:  # type: ignore[override]  # torch's own returns None
        """From here on run as compiled kernels, on CPU or GPU: same results (to rounding), same gradients.

        It needs a C++ compiler (what ``CXX`` names, or ``g++``, ``clang++``, zig), on a GPU torch's own NVRTC, and some
        seconds for a form of call that no earlier process has compiled.  Gradients are of first order.  Under
        ``torch.compile`` and in transforms of ``torch.func`` the filter runs as without.
        ``torchfra/kernel/README.md`` has the details.

        Args:
            args: with any argument this is ``nn.Module.compile``, and so ``torch.compile``, instead:
                ``f.compile(backend="inductor")``.
            options: likewise.

        Returns:
            The filter itself.

        Raises:
            CompileError: (a ``RuntimeError``) when a kernel is needed and there is no compiler.
            NotImplementedError: then too, if the filter does what kernels cannot.
        """
        if args or options:
            super().compile(*args, **options)
        else:
            from torchfra.filters.compiled import Compiled

            self._kernels = Compiled()
        return self
