# SPDX-License-Identifier: MIT
"""The judge of ports: it knows the reference, `stss_ref`, and no port."""
