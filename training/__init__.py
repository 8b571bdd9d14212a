# SPDX-License-Identifier: MIT
"""How weights are made: samples, augmentation, loss, training. Needs PyTorch; not part of the installed program."""
