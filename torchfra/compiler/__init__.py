"""From a filter's step to machine code: ``README.md`` beside this file begins with a page that says how.

- A filter: ``engine`` is what it holds once it is compiled, ``background`` what it holds if it does not wait for that;
  ``version`` the filter as it is now, while it is ``unchanged``; ``traced`` and ``backward`` what is traced of
  it; ``single_steps`` and ``whole_tracks`` calls of a form that is known; ``export`` for use without torch.
- Trace: ``step`` (backwards too), ``tangents`` (derivatives forwards), ``boundary`` and
  ``boundary_gradient`` (what comes before the first step and after the last); on ``entries`` with the rules of
  ``entrywise``, ``reductions`` and ``moves``, put together in ``operations``; ``routines``, ``refusals``, ``origin``,
  ``copies``, ``trees``.
- Simplify: ``expressions``, ``choices``, ``divisions``.
- Plan: ``plan``, in the order of ``schedule`` and ``merges``, in places of ``frame``.
- Write: ``source``; as instructions of LLVM by ``native`` (a step), ``tensor_entries``, ``elementary_functions``,
  ``gathering`` (regions), ``sharing`` (threads) and ``track_native`` (whole tracks), with ``instructions``; as C++ by
  ``writer`` and ``statements``, with ``access`` and ``names``, for GPUs and, ``standalone``, for use without torch.
- Compile: ``jit`` with ``llvm``, ``processor`` and ``cache``; ``cuda`` for GPUs.
- Run: ``program`` one loop, ``run`` all of a step, ``track_kernel`` and ``learning`` calls that come again and again;
  ``guards``, ``pages``.
"""
