# SPDX-License-Identifier: MIT
"""The device: choose it, build programs for it, its buffers and its tuning."""
