"""From a filter's step to machine code.

``expressions`` holds arithmetic on single numbers; ``entries`` are tensors of expressions, which torch code runs on by
the rules of ``entrywise``, ``reductions`` and ``moves``, put together in ``operations``; ``step`` traces a step and its
gradient, ``source`` turns them into C++ (``template.cpp``), ``build`` compiles it, ``program`` and ``run`` run it on
tensors; ``standalone`` writes C++ that needs no library.
"""
