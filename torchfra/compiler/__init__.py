"""From a filter's step to machine code: ``README.md`` beside this file begins with a page that says how.

- A filter: ``engine`` has what it holds once it is compiled, and what it holds if it does not wait for that;
  ``version`` the filter as it is now, ``traced`` and ``backward`` what is traced of it; ``ready`` calls of a form that
  is known; ``one_operation`` what ``torch.compile`` sees; ``export`` for use without torch.
- Trace: ``step`` (backwards too), ``tangents`` (derivatives forwards), ``boundary`` (what comes before the first step
  and after the last); on ``entries`` with the rules of ``entrywise``, ``reductions`` and ``moves``, put together in
  ``operations``; ``routines``, ``origin``.
- Simplify: ``expressions``.
- Plan: ``source``, a loop over time; ``rewrites`` of its step; ``plan``, in the order of ``schedule``.
- Write: as instructions of LLVM by ``native`` (a step), ``tensor_entries``, ``elementary_functions``, ``gathering``
  (regions) and ``sharing`` (threads), with ``instructions``; as C++ by ``cpp``, for GPUs and for ``export``.
- Compile: ``jit`` with ``llvm`` and ``cache``; ``cuda`` for GPUs.
- Run: ``program`` one loop, ``run`` all of a step, ``track_kernel`` and ``learning`` calls that come again and again;
  ``forms``, ``pages``.
"""
