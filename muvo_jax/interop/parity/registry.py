"""All packs that can be checked, in the order in which they run."""

from __future__ import annotations

from muvo_jax.interop.parity import cases, losses, modules_1d, modules_2d, p6

PACKS = (
    cases.PackChecks("p1", (r"p1_losses_metrics\.npz",), losses.GROUPS),
    cases.PackChecks("p3_1d", (r"p3_modules_1d\.npz",), modules_1d.GROUPS),
    cases.PackChecks("p3_2d", (r"p3_modules_2d\.npz",), modules_2d.GROUPS),
    cases.PackChecks("p6", (r"p6_\w+\.npz",), p6.GROUPS, needs_recordings=True),
)
