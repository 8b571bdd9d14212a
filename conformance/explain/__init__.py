# SPDX-License-Identifier: MIT
"""Explain a wrong answer: the mistake, the layer, the term."""
