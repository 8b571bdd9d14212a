# SPDX-License-Identifier: MIT
"""``stss run``: a sequence of files in, a folder of files out."""
