# SPDX-License-Identifier: MIT
"""The version, and the name under which it is distributed."""

VERSION = "0.1.0"
DISTRIBUTION = "spacetime-supersampling"
"""The name that ``pip`` lists: on the package index ``stss`` is another project. This one is on no index yet."""
