# SPDX-License-Identifier: MIT
"""The judge of any network: an ONNX model in float64, each tensor with the error that rounding can cause."""
