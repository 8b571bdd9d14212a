# SPDX-License-Identifier: MIT
"""Methods without a network: FXAA, temporal upsampling, plain enlarging."""
