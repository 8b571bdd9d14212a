# SPDX-License-Identifier: MIT
"""Space-time supersampling: frames in, twice the resolution and twice the frame rate out."""
