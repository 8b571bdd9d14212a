# SPDX-License-Identifier: MIT
"""The judge of ports: it knows the reference, `stss_ref`, and no port."""

import os

# Threads of linear algebra wait busily for each other, and the judge's matrices are small: one takes two thirds of the time of two.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
