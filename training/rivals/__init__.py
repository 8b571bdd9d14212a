# SPDX-License-Identifier: MIT
"""The paper's learned rivals, ExtraNet and NSRR, written from their papers: trained, run and timed beside STSS. None of it is in `stss`."""
