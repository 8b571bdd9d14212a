# SPDX-License-Identifier: MIT
"""How good a picture is: ``stss compare``, ``methods`` and ``flicker``."""
