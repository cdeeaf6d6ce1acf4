"""The process that computes: its memory and its compiler."""

from __future__ import annotations

import os
import resource
import sys

import jaxlib.version

TUNABLES_VARIABLE = "GLIBC_TUNABLES"
FLAGS_VARIABLE = "XLA_FLAGS"
EMITTERS = "--xla_cpu_use_fusion_emitters"
# XLA ends a process whose flags it does not know: only releases are asked that were measured.
EMITTERS_OF = "0.10."


def peak_memory_gib() -> float:
    """The most memory this process has held so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20


def restart_with_huge_pages() -> None:
    """Starts this program again with huge pages for large buffers; returns where that is so already, or is no use.

    XLA's CPU backend takes fresh buffers in every step and glibc hands them back to the system after it, so that each
    step pays for page faults: layers that are limited by memory run 1.3 to 2 times faster with huge pages. glibc reads
    the setting when a process starts, hence the restart; a GLIBC_TUNABLES of the user's own is left alone.
    """
    if sys.platform != "linux" or TUNABLES_VARIABLE in os.environ or not sys.orig_argv[1:]:
        return
    environment = {**os.environ, TUNABLES_VARIABLE: "glibc.malloc.hugetlb=1"}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


def use_plain_emitters() -> None:
    """Has XLA generate code for the CPU without its fusion emitters, in programs that are compiled from here on.

    With them (the default of jaxlib 0.10) the town's training step and its compilation take a tenth more processor
    time, and small programs compile twice as long (docs/performance.md, "Start-up"). XLA reads its flags before its
    first computation, hence an environment variable; a choice of the user's is left alone.
    """
    flags = os.environ.get(FLAGS_VARIABLE, "")
    if jaxlib.version.__version__.startswith(EMITTERS_OF) and EMITTERS not in flags:
        os.environ[FLAGS_VARIABLE] = f"{flags} {EMITTERS}=false".strip()
