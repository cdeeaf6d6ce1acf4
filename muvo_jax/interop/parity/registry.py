"""All packs that can be checked, in the order in which they run."""

from __future__ import annotations

from muvo_jax.interop.parity import cases, full_models, geometry, losses, modules_1d, modules_2d, p6

# Any name that says sensors and fusion, such as 1d_RV_WOB_TR_voxel; and the two that say less.
_FULL_MODELS = (r"(1d_|2d_)?(RV|PP)_(WOB|BEV)_(TR|FC)\w*\.npz", r"2d_(bevseg|measurements|mobilevit)\.npz")

PACKS = (
    cases.PackChecks("p1", (r"p1_losses_metrics\.npz",), losses.GROUPS),
    cases.PackChecks("p2", (r"p2_geometry\.npz",), geometry.GROUPS, geometry.LEFT_OUT),
    cases.PackChecks("p3_1d", (r"p3_modules_1d\.npz",), modules_1d.GROUPS),
    cases.PackChecks("p3_2d", (r"p3_modules_2d\.npz",), modules_2d.GROUPS),
    cases.PackChecks("p4", _FULL_MODELS, full_models.GROUPS),
    cases.PackChecks("p6", (r"p6_\w+\.npz",), p6.GROUPS, needs_recordings=True),
)
