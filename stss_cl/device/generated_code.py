# SPDX-License-Identifier: MIT
"""The Python code that PyOpenCL generates for kernels: never read from a file, and generated once for equal kernels."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import pyopencl as cl

_GENERATE = "_generate_enqueue_and_set_args_module"


def generate_once() -> None:
    """Change two private settings of PyOpenCL, which has no public ones: ``$PYOPENCL_NO_CACHE`` counts only before its import."""
    # It keeps the code as pickles, which may run code, in a folder that other programs share and that the umask alone protects.
    # It looks at this flag at every call.
    cl._PYOPENCL_NO_CACHE = True  # noqa: SLF001

    # Without that folder it writes and compiles a module for every kernel object, looks for a free name among those of all the others,
    # and never lets one go. Kernels with the same name and number of arguments get the same code.
    invoker = import_module("pyopencl.invoker")  # after the line above, or the import makes the folder
    if hasattr(invoker, _GENERATE):
        setattr(invoker, _GENERATE, cache(getattr(invoker, _GENERATE)))
