# SPDX-License-Identifier: MIT
"""The quality of a picture: ``stss compare``, and the parts of it that ``stss methods`` uses."""
