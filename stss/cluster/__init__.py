# SPDX-License-Identifier: MIT
"""``stss run --cluster``: one run on many machines, by dask.distributed."""
