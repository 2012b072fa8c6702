"""Square-root algebra: triangularisation, downdates and functions of Gram matrices, all with exact gradients.

No covariance is formed here.  Everything works on a square root ``A`` of it, ``P = A A^T``, and on the unique
lower-triangular root with a non-negative diagonal, ``L = tria(A)``.  Behind it stands the QR decomposition of ``A^T``,
in three ways that agree to rounding (``tests/linalg/test_tria.py`` holds all of them, and their gradients, to those of
``torch.linalg.qr``):

- traced code (``torch.func``) calls ``torch.linalg.qr(mode="r")``;
- eager code calls ``torch.geqrf``, the routine behind it, whose result is the same to the bit.  With torch's default of
  a thread for each core an eager step of one track would take 3.7 times as long by ``torch.linalg.qr``
  (``triangular._reflect``); with one thread it would not matter;
- compiled kernels and GPUs orthogonalise the rows entry by entry.

The gradient is a formula of its own in all three, as torch has none for ``mode="r"``, and those of its other modes need
the orthogonal factor and full rank.
"""

from torchfra.linalg.covariance import covariance_root
from torchfra.linalg.gram import downdate, gram_information, gram_pinv
from torchfra.linalg.safe import in_range, safe_divide, safe_log, safe_sqrt, safe_square
from torchfra.linalg.tracing import elementary, is_elementary, is_traced
from torchfra.linalg.triangular import apply, hstack, tria, tria_beside, whiten

__all__ = [
    "apply",
    "covariance_root",
    "downdate",
    "elementary",
    "gram_information",
    "gram_pinv",
    "hstack",
    "in_range",
    "is_elementary",
    "is_traced",
    "safe_divide",
    "safe_log",
    "safe_sqrt",
    "safe_square",
    "tria",
    "tria_beside",
    "whiten",
]
