"""Square-root algebra: triangularisation with an exact, rank-safe gradient, downdates, functions of Gram matrices.

A covariance is never formed here.  Everything works on a square root ``A`` of it, ``P = A A^T``, and on the one
lower-triangular root with non-negative diagonal, ``L = tria(A)``.
"""

from torchfra.linalg.gram import downdate, gram_pinv, gram_sqrt
from torchfra.linalg.tracing import elementary, is_elementary, is_traced
from torchfra.linalg.triangular import apply, hstack, tria, whiten

__all__ = [
    "apply",
    "downdate",
    "elementary",
    "gram_pinv",
    "gram_sqrt",
    "hstack",
    "is_elementary",
    "is_traced",
    "tria",
    "whiten",
]
