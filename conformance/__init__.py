# SPDX-License-Identifier: MIT
"""Judges ports of the reference; knows `stss_ref` and no port."""
