# SPDX-License-Identifier: MIT
"""How good a picture is: ``stss compare``, and what ``methods`` takes of it."""
