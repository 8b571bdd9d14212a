# SPDX-License-Identifier: MIT
"""The judge of ports: it imports the reference, `stss_ref`, and no port."""
