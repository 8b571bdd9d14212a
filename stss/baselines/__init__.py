# SPDX-License-Identifier: MIT
"""What one would use without a network: FXAA, temporal upsampling, plain enlarging."""
