"""Keep freed memory in the process: a fresh page costs more than the arithmetic on it."""

import ctypes
import platform
from functools import cache

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3


@cache
def keep_freed_memory() -> bool:
    """Ask glibc not to return blocks of up to 32 MiB to the system; return whether it agreed.

    By default they are returned when freed, and every training step faults them in again (a third of its time with 20k
    Gaussians). Other C libraries are left as they are.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    settings = ((M_MMAP_THRESHOLD, 32 << 20), (M_TRIM_THRESHOLD, 1 << 30), (M_TOP_PAD, 16 << 20))
    return all(mallopt(*pair) == 1 for pair in settings)
