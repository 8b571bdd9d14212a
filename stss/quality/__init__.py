# SPDX-License-Identifier: MIT
"""The quality of images: ``stss compare``, and the parts of it that ``stss methods`` uses."""
