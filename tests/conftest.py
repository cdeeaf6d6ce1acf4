"""Every test sees 8 virtual CPU devices and raises on implicit rank promotion.

Compiling takes most of the suite's time, so XLA leaves most of its optimisations out; JAX_DISABLE_MOST_OPTIMIZATIONS=0
tests the programs that users run (.ci/run does so for the slow tests). The emitters are those that commands choose.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"

import jax
import pytest

from muvo_jax.training import host

host.use_plain_emitters()
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture
def strict_dtypes():
    """Implicit dtype promotion raises inside tests of float32 code (ops, model, objectives)."""
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(scope="module")
def fast_compilation():
    """For slow tests that are compilation above all and ask nothing of an optimised program."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
