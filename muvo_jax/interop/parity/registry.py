"""All kinds of golden files that can be checked, in the order in which they run."""

from __future__ import annotations

from muvo_jax.interop.parity import (
    all_losses,
    cases,
    full_models,
    geometry,
    golden,
    losses,
    modules_1d,
    modules_2d,
    p6,
    train_step,
)

_BACKBONES = "mobilevitv2_100_backbones"
_FULL_MODELS = tuple(rf"{name}\.npz" for name in golden.manifest_names() if name != _BACKBONES)

FILES = (
    cases.FileChecks("p1", (r"p1_losses_metrics\.npz",), losses.GROUPS),
    cases.FileChecks("p2", (r"p2_geometry\.npz",), geometry.GROUPS, geometry.LEFT_OUT),
    cases.FileChecks("p3_1d", (r"p3_modules_1d\.npz",), modules_1d.GROUPS),
    cases.FileChecks("p3_2d", (r"p3_modules_2d\.npz",), modules_2d.GROUPS),
    cases.FileChecks("p4", _FULL_MODELS, full_models.GROUPS),
    cases.FileChecks("p4_backbone", (r"mobilevitv2_100_backbone\.npz",), full_models.BACKBONE_GROUPS),
    cases.FileChecks("p5_losses", (r"p5_losses_all_[12]d\.npz",), all_losses.GROUPS),
    cases.FileChecks("p5_schedules", (r"p5_schedules\.npz",), (train_step.schedules,)),
    cases.FileChecks("p5_step", (r"p5_train_step_[12]d\.npz",), train_step.GROUPS),
    cases.FileChecks("p6", (r"p6_\w+\.npz",), p6.GROUPS, needs_recordings=True),
)
