# SPDX-License-Identifier: MIT
"""What every package stands on: errors, printing, whole files, pages, checked reading. Neither arrays of a stage nor a device."""
