# SPDX-License-Identifier: MIT
"""Choose and test the device that computes: ``stss devices``, the self-test, ``stss tune``."""
