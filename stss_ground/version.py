# SPDX-License-Identifier: MIT
"""The version of the distribution ``spacetime-supersampling``; on the package index ``stss`` is another project."""

VERSION = "0.1.0"
