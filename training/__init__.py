# SPDX-License-Identifier: MIT
"""Make weights: samples, augmentation, loss, training. Needs PyTorch; not part of the installed program."""
