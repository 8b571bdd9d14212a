# SPDX-License-Identifier: MIT
"""Instruments: methods to compare with, benchmarks, stress tests, the tuner. Their commands are in ``stss``."""
