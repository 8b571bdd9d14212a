# SPDX-License-Identifier: MIT
"""The base of all packages: errors, printing, whole files, pages, checked reading. It knows no stage and no device."""
