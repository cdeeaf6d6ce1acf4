"""How commands prepare the process that computes."""

import os

import jaxlib.version
import pytest

from muvo_jax.training import host


@pytest.mark.parametrize(("before", "after"), [
    ("", "--xla_cpu_use_fusion_emitters=false"),
    ("--xla_dump_to=dump", "--xla_dump_to=dump --xla_cpu_use_fusion_emitters=false"),
    ("--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true")])
def test_emitters_are_chosen_unless_the_user_did(before, after, monkeypatch):
    monkeypatch.setattr(jaxlib.version, "__version__", "0.10.2")
    monkeypatch.setenv("XLA_FLAGS", before)
    host.use_plain_emitters()
    host.use_plain_emitters()
    assert os.environ["XLA_FLAGS"] == after


def test_a_release_that_may_not_know_the_flag_gets_none(monkeypatch):
    monkeypatch.setattr(jaxlib.version, "__version__", "0.11.0")
    monkeypatch.setenv("XLA_FLAGS", "")
    host.use_plain_emitters()
    assert os.environ["XLA_FLAGS"] == ""
