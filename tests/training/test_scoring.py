"""Heads decoded one frame after the other: the same loss, statistics and gradients, and less memory for more frames."""

import dataclasses
import functools

import jax
import numpy as np
import optax
import small_world

from muvo_jax.training import scoring
from muvo_jax.training import step as step_lib

TOLERANCE = 1e-5  # of the global norm, as between devices: only the order of additions differs


@functools.cache
def everything_of(remat):
    """What a step gives, every term on and two of three frames of each window decoded, and the bytes it works in."""
    config = small_world.make_config()
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, remat=remat))
    model = small_world.SmallWorld(config.model)
    variables, batch = model.init(), small_world.make_batch(config.model)
    keys = step_lib.sample_keys(jax.random.key(1), 0, 0, small_world.WINDOWS, None)
    differentiate = jax.jit(jax.value_and_grad(functools.partial(
        step_lib.forward, model=model, config=config, train=True, axis_name=None), has_aux=True))
    arguments = (variables["params"], variables["batch_stats"], batch, keys)
    compiled = differentiate.lower(*arguments).compile()
    return jax.tree.map(np.asarray, compiled(*arguments)), compiled.memory_analysis().temp_size_in_bytes


def test_frames_one_after_the_other_give_the_loss_and_gradients_of_all_at_once():
    ((_, (metrics, batch_stats)), gradients), memory = everything_of("none")
    ((_, (got_metrics, got_stats)), got_gradients), got_memory = everything_of("frames")
    assert got_memory < 0.9 * memory
    assert got_metrics.keys() == metrics.keys() and {scoring.PSNR, "chamfer_1", "kl"} < metrics.keys()
    for name, value in metrics.items():
        np.testing.assert_allclose(got_metrics[name], value, rtol=1e-5, err_msg=name)
    jax.tree.map(lambda got, want: np.testing.assert_allclose(got, want, rtol=1e-5), got_stats, batch_stats)
    norm = float(optax.global_norm(gradients))
    assert norm > 1e-3
    apart = jax.tree.map(lambda got, want: np.abs(got - want).max(), got_gradients, gradients)
    assert max(jax.tree.leaves(apart)) < TOLERANCE * norm
