"""From a filter's step to machine code.

``expressions`` writes arithmetic on single numbers down, ``entries`` lets torch code do so, ``step`` traces a step and
its gradient, ``source`` turns them into C++, ``build`` compiles that, ``run`` runs it on tensors.
"""
