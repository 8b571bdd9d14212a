"""The bound of a sum of products, for tests of several folders."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from conformance.tolerance import UNIT


def sum_bound(terms: int, absolute: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """Bound on the difference of two sums of ``terms`` products in ``dtype``: ``2 gamma_n |a| . |b|`` (Higham, section 3.1).

    Args:
        terms: products in one sum, the bias and one rounding for it included.
        absolute: the sum on absolute values, in float64.
        dtype: the arithmetic of both.

    Returns:
        As ``absolute``.
    """
    unit = UNIT[np.dtype(dtype).name]
    return 2 * terms * unit / (1 - terms * unit) * absolute
