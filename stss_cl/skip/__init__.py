# SPDX-License-Identifier: MIT
"""What need not be computed: changes, flat tiles, the frames kept for it."""
