"""Memory that large fits leave behind."""

import ctypes
import sys


def return_free_memory() -> None:
    """Give free memory back to the system where the C library offers that (`malloc_trim` of glibc); else do nothing.

    After fits of thousands of unknowns more than 100 MB are free in pieces between what is in use, and the matrices of
    the next fit would come on top of them.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
