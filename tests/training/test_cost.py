"""What a step would cost: counted by hand where that is possible, and put into settings that fit."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from muvo_jax import config as config_lib
from muvo_jax import estimate, presets
from muvo_jax.ops import conv
from muvo_jax.training import cost, screen

COST = cost.StepCost("one cpu device", 10, state_bytes=100, batch_bytes=10, working_bytes=50, operations=1e9,
                     compilation_s=1.0)


def of(function, *shapes):
    return cost.operations(jax.make_jaxpr(function)(*(jnp.zeros(shape) for shape in shapes)).jaxpr)


def test_operations_of_products_convolutions_loops_and_gradients_by_hand():
    product = lambda a, b: a @ b
    assert of(product, (3, 5), (5, 7)) == 2 * 3 * 5 * 7
    looped = lambda a, b: jax.lax.scan(lambda carry, _: (carry @ b, None), a, length=4)[0]
    assert of(looped, (3, 5), (5, 5)) == 4 * 2 * 3 * 5 * 5
    assert of(jax.grad(lambda a, b: (a @ b).sum(), argnums=(0, 1)), (3, 5), (5, 7)) == 3 * 2 * 3 * 5 * 7
    again = jax.grad(lambda a, b: jax.checkpoint(lambda a: jnp.sin(a @ b) @ b)(a).sum())
    assert of(again, (3, 5), (5, 5)) == 5 * 2 * 3 * 5 * 5  # two forward, one of them again, two back
    layer = lambda x, kernel: conv.conv(x, kernel, padding=1, implementation="xla")
    assert of(layer, (2, 8, 8, 3), (3, 3, 3, 4)) == 2 * 2 * 8 * 8 * 9 * 3 * 4
    axes = ("NHWC", "HWIO", "NHWC")
    larger = lambda x, kernel: jax.lax.conv_transpose(x, kernel, (2, 2), "SAME", dimension_numbers=axes)
    assert of(larger, (2, 8, 8, 3), (4, 4, 3, 5)) == 2 * 2 * 8 * 8 * 16 * 3 * 5  # each input meets the kernel once


def test_of_branches_the_dearest_counts_and_of_forms_that_of_this_platform():
    once, twice = (lambda a, b: a @ b), (lambda a, b: (a @ b) @ b)
    choice = lambda a, b: jax.lax.cond(a.sum() > 0, once, twice, a, b)
    assert of(choice, (3, 5), (5, 5)) == 2 * 2 * 3 * 5 * 5
    forms = lambda a, b: jax.lax.platform_dependent(a, b, cpu=once, default=twice)
    elsewhere = lambda a, b: jax.lax.platform_dependent(a, b, tpu=once, default=twice)
    assert jax.default_backend() == "cpu"
    assert of(forms, (3, 5), (5, 5)) == 2 * 3 * 5 * 5
    assert of(elsewhere, (3, 5), (5, 5)) == 2 * 2 * 3 * 5 * 5


def test_a_rate_is_that_of_a_processor():
    assert 1e8 < cost.product_rate() < 1e13


@pytest.mark.parametrize(("available", "windows"), [(160, 1), (199, 1), (200, 2), (245, 3), (90, 0)])
def test_the_largest_batch_follows_from_two(available, windows):
    more = dataclasses.replace(COST, working_bytes=130)  # 40 bytes a window
    assert COST.total_bytes == 160
    assert cost.largest_batch((1, COST), (3, more), available) == windows


class Costs:
    """Costs by arithmetic instead of compilation: 100 bytes, and for each window 40, half of it with "heads"."""

    def __init__(self):
        self.asked = []

    def __call__(self, config):
        self.asked.append((config.train.remat, config.train.batch))
        each = {"none": 40, "heads": 20, "frames": 10}[config.train.remat]
        return dataclasses.replace(COST, state_bytes=100, batch_bytes=0, working_bytes=each * config.train.batch)


@pytest.mark.parametrize(("available", "fixed", "found"), [
    (1000, False, ("none", 16, 1)), (190, False, ("none", 2, 8)), (130, False, ("heads", 1, 16)),
    (115, False, ("frames", 1, 16)), (105, False, None), (130, True, None)])
def test_what_fits_keeps_the_windows_of_an_update(monkeypatch, available, fixed, found):
    monkeypatch.setattr(estimate, "of_config", Costs())
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    config = config_lib.override_all(presets.get("paper"), {"train.remat": "none"})
    assert (config.train.batch, config.optimizer.accumulate) == (1, 16)
    fits = estimate.suggest(config, available, fixed=fixed)
    assert (fits and (fits.train.remat, fits.train.batch, fits.optimizer.accumulate)) == found
    if fits:
        assert dataclasses.replace(fits, train=config.train, optimizer=config.optimizer) == config


def test_the_command_says_what_is_needed_what_fits_and_that_nothing_does(monkeypatch, capsys):
    monkeypatch.setattr(estimate, "of_config", Costs())
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    monkeypatch.setattr(estimate, "of_process", lambda config: 1000.0)
    monkeypatch.setattr(cost, "product_rate", lambda dtype: 1e9)
    options = estimate.Options(preset="paper-occupancy", memory_gib=1130 / 2**30, share=0.25)
    estimate.estimate(options, screen.Screen())
    shown = capsys.readouterr().out
    assert "16 windows of 6 frames an update, 1 at a time (--batch=1 --accumulate=16), train.remat=heads" in shown
    assert "4.00 processor seconds a step" in shown and "25% of the 1 GFLOP a second" in shown
    assert "as it is" in shown
    estimate.estimate(dataclasses.replace(options, memory_gib=1.0), screen.Screen())
    assert "--batch=16 --accumulate=1 --set train.remat=none" in capsys.readouterr().out
    with pytest.raises(ValueError, match="not even one window at a time fits"):
        estimate.estimate(dataclasses.replace(options, memory_gib=0.0), screen.Screen())


def test_a_batch_that_devices_cannot_share_evenly_is_looked_at_before_it_is_named(monkeypatch):
    """Two of eight devices hold a window each: a size of its own says nothing of the next one."""
    def of_config(config):
        on = max(size for size in range(1, 9) if config.train.batch % size == 0)
        return dataclasses.replace(COST, state_bytes=100, batch_bytes=0, working_bytes=40 * config.train.batch // on)

    monkeypatch.setattr(estimate, "of_config", of_config)
    monkeypatch.setattr(jax, "device_count", lambda: 8)
    config = config_lib.override_all(presets.get("paper"), {"optimizer.accumulate": 36})
    fits = estimate.suggest(config, 220.0, fixed=True)
    assert of_config(fits).total_bytes <= 220 and (fits.train.batch, fits.optimizer.accumulate) == (18, 2)
