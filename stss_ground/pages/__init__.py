# SPDX-License-Identifier: MIT
"""HTML pages in one file: style, tables, plots."""
