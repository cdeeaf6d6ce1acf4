"""OneCycle against torch's numbers, AdamW by hand, decay groups, clipping."""

import dataclasses

import chex
import golden_rule
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from muvo_jax import config as config_lib
from muvo_jax.training import optimizer as optimizer_lib

CONFIG = config_lib.OptimizerConfig()


@pytest.mark.parametrize("total_steps", [50_000, 100_000])
def test_schedules_match_torch(total_steps):
    golden = golden_rule.Golden("p5_schedules.npz")
    steps = jnp.asarray(golden[f"onecycle_{total_steps}/step"].astype(np.int32))
    rates = jax.vmap(optimizer_lib.learning_rate(CONFIG, total_steps))(steps)
    momenta = jax.vmap(optimizer_lib.beta1(CONFIG, total_steps))(steps)
    np.testing.assert_allclose(rates, golden[f"onecycle_{total_steps}/lr"], rtol=1e-6)
    np.testing.assert_allclose(momenta, golden[f"onecycle_{total_steps}/beta1"], rtol=1e-6)


def test_schedule_by_arithmetic():
    # 100 steps: from 1/25 at step 0 to the peak at step 19, halfway up at 9.5, down to 1/250000 at step 99 and after.
    rate = optimizer_lib.learning_rate(dataclasses.replace(CONFIG, learning_rate=1.0), 100)
    np.testing.assert_allclose([rate(step) for step in (0, 19, 99, 500)], [0.04, 1.0, 4e-6, 4e-6], rtol=1e-6)
    np.testing.assert_allclose(rate(9), 0.04 + 0.96 * (1 - np.cos(np.pi * 9 / 19)) / 2, rtol=1e-6)
    np.testing.assert_allclose(rate(59), 4e-6 + (1 - 4e-6) / 2, rtol=1e-5)


@pytest.mark.parametrize("total_steps", [1, 2, 4, 5])
def test_short_runs_have_finite_rates(total_steps):
    rates = np.array([optimizer_lib.learning_rate(CONFIG, total_steps)(step) for step in range(total_steps + 1)])
    assert np.isfinite(rates).all()
    assert (rates > 0).all() and (rates <= CONFIG.learning_rate * (1 + 1e-6)).all()


def torch_adamw(parameter, gradients, decay, total_steps):
    """The update rule of torch.optim.AdamW in float64, one list entry per step."""
    rate, beta1 = optimizer_lib.learning_rate(CONFIG, total_steps), optimizer_lib.beta1(CONFIG, total_steps)
    first, second = np.zeros_like(parameter), np.zeros_like(parameter)
    for count, gradient in enumerate(gradients, start=1):
        lr, b1, b2 = float(rate(count - 1)), float(beta1(count - 1)), CONFIG.beta2
        parameter = parameter * (1 - lr * decay)
        first, second = b1 * first + (1 - b1) * gradient, b2 * second + (1 - b2) * gradient**2
        denominator = np.sqrt(second) / np.sqrt(1 - b2**count) + CONFIG.epsilon
        parameter = parameter - lr / (1 - b1**count) * first / denominator
    return parameter


def test_updates_match_torch_with_cycled_momentum_and_two_groups():
    generator = np.random.default_rng(0)
    shapes = {"kernel": (3, 4), "bias": (4,), "scalar": ()}
    params = {name: generator.normal(size=shape) for name, shape in shapes.items()}
    gradients = [{name: generator.normal(size=value.shape) for name, value in params.items()} for _ in range(6)]
    optimizer = optimizer_lib.make_optimizer(CONFIG, 10)
    ours = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
    state = optimizer.init(ours)
    for gradient in gradients:
        gradient = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), gradient)
        updates, state = optimizer.update(gradient, state, ours)
        ours = optax.apply_updates(ours, updates)
    for name, decay in (("kernel", 0.01), ("bias", 0.0), ("scalar", 0.01)):
        expected = torch_adamw(params[name], [gradient[name] for gradient in gradients], decay, 10)
        moved = np.abs(expected - params[name]).max()
        assert np.abs(ours[name] - expected).max() < 1e-3 * moved


def test_a_transformation_of_two_vectors_is_one_of_trees():
    """Against optax on the leaves themselves; a frozen leaf (None) is none."""
    generator = np.random.default_rng(0)
    tree = {"kernel": (2, 3), "bias": (4,), "scalar": (), "more": {"scale": (3,)}, "frozen": None}
    draw = lambda: jax.tree.map(lambda shape: jnp.asarray(generator.normal(size=shape), jnp.float32), tree,
                                is_leaf=lambda node: isinstance(node, tuple))
    plain = optax.adamw(0.1, weight_decay=0.5, mask=lambda params: jax.tree.map(lambda leaf: leaf.ndim != 1, params))
    packed = optimizer_lib.packed(optax.adamw(0.1, weight_decay=0.5, mask=optimizer_lib.decays))
    params = draw()
    states = [plain.init(params), packed.init(params)]
    for _ in range(3):
        gradients, updates = draw(), []
        for index, transformation in enumerate((plain, packed)):
            update, states[index] = transformation.update(gradients, states[index], params)
            updates.append(update)
        chex.assert_trees_all_close(updates[1], updates[0], rtol=1e-6)
        for leaf_by_leaf in (False, True):
            np.testing.assert_allclose(optimizer_lib.norm(gradients, leaf_by_leaf=leaf_by_leaf),
                                       optax.global_norm(gradients), rtol=1e-6)
        params = optax.apply_updates(params, updates[1])
    assert params["frozen"] is None
    vectors = [leaf.shape for leaf in jax.tree.leaves(states[1]) if leaf.ndim]
    assert sorted(vectors) == [(7,), (7,), (7,), (7,)]  # kernel and scalar, bias and scale: two moments each
    assert set(states[1][0].mu) == {"decayed", "undecayed"}  # names in the checkpoints of all runs so far


def test_clipping_limits_the_global_norm():
    # Adam's first update does not depend on the gradient's scale, but the second moment keeps it.
    gradient = {"w": jnp.array([[3.0, 4.0]])}
    for clip_norm, expected in ((0.0, 25.0), (1.0, 1.0)):
        optimizer = optimizer_lib.make_optimizer(dataclasses.replace(CONFIG, clip_norm=clip_norm), 10)
        _, state = optimizer.update(gradient, optimizer.init(gradient), gradient)
        moments = [leaf for path, leaf in jax.tree_util.tree_leaves_with_path(state)
                   if "nu" in jax.tree_util.keystr(path)]
        np.testing.assert_allclose(sum(moment.sum() for moment in moments), expected * (1 - CONFIG.beta2), rtol=1e-3)


def test_a_state_takes_the_constants_of_todays_settings():
    """optax keeps them in the state: restored ones would win."""
    before, now = (config_lib.OptimizerConfig(weight_decay=decay, beta2=beta2, clip_norm=1.0)
                   for decay, beta2 in ((0.01, 0.99), (0.5, 0.9)))
    params = {"kernel": jnp.ones((3, 2)), "bias": jnp.ones(2)}
    gradients = jax.tree.map(lambda leaf: 0.1 * leaf, params)
    old, new = (optimizer_lib.make_optimizer(config, 10) for config in (before, now))
    state = old.update(gradients, old.init(params), params)[1]
    resumed = optimizer_lib.with_constants(state, new.init(params))
    assert jax.tree.structure(resumed) == jax.tree.structure(state)
    found = optax.tree_utils.tree_get(resumed, "weight_decay"), optax.tree_utils.tree_get(resumed, "b2")
    np.testing.assert_allclose(found, (0.5, 0.9))
    np.testing.assert_array_equal(optax.tree_utils.tree_get(resumed, "mu")["decayed"],
                                  optax.tree_utils.tree_get(state, "mu")["decayed"])
    moved = new.update(gradients, resumed, params)[0]["kernel"] - new.update(gradients, state, params)[0]["kernel"]
    assert np.abs(moved).min() > 0.0
