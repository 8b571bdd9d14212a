# SPDX-License-Identifier: MIT
"""What a wrong answer looks like: which mistake, which layer, which term."""
