"""Memory that is free but still held by the C library, handed back to the system."""

import ctypes
import os


def hand_back_memory() -> None:
    """Hand back what glibc keeps of freed memory; with another C library nothing is done.

    glibc keeps arrays of up to 32 MB in its heap, of which only the end goes back by itself: after the first
    placement of 2,500 images that is 345 of 837 MB. It takes milliseconds: called between stages.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(ctypes.c_size_t(0))
