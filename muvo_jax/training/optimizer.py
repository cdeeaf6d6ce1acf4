"""AdamW under torch's OneCycle schedule, as the reference trains.

Own schedule, because optax's one-cycle differs from torch's by up to 8e-4 and leaves beta1 alone, which torch cycles
against the rate by default. Weight decay applies to every parameter that does not have exactly one axis, as in the
reference.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from muvo_jax import config as config_lib
from muvo_jax import types

Schedule = Callable[[types.Array], types.Array]


def one_cycle(total_steps: int, *, start: float, peak: float, end: float, warmup_fraction: float) -> Schedule:
    """Half a cosine from `start` to `peak`, then half a cosine to `end`.

    The peak lies at step warmup_fraction * total_steps - 1 and the end at total_steps - 1, where the value then stays.

    Args:
      total_steps: optimiser steps of the whole run.
      start, peak, end: values; the same function serves a quantity that is lowest at the peak.
      warmup_fraction: share of the steps before the peak.

    Returns:
      step (int32 scalar, from 0) -> float32 scalar, the value to use in that step.
    """
    peak_step = warmup_fraction * total_steps - 1.0
    last_step = total_steps - 1.0

    def schedule(step):
        step = jnp.asarray(step).astype(jnp.float32)
        # Both branches run from the nearer end of the cosine as a squared sine: 1 + cos would lose the small values.
        rising = jnp.clip(step / max(peak_step, 1e-6), 0.0, 1.0)
        remaining = jnp.clip((last_step - step) / max(last_step - peak_step, 1e-6), 0.0, 1.0)
        warm = start + (peak - start) * jnp.square(jnp.sin(rising * (jnp.pi / 2)))
        cool = end + (peak - end) * jnp.square(jnp.sin(remaining * (jnp.pi / 2)))
        return jnp.where(step <= peak_step, warm, cool)

    return schedule


def learning_rate(config: config_lib.OptimizerConfig, total_steps: int) -> Schedule:
    """The rate of each optimiser step."""
    start = config.learning_rate / config.start_divisor
    return one_cycle(total_steps, start=start, peak=config.learning_rate, end=start / config.end_divisor,
                     warmup_fraction=config.warmup_fraction)


def beta1(config: config_lib.OptimizerConfig, total_steps: int) -> Schedule:
    """Adam's first momentum of each optimiser step: low where the rate is high."""
    return one_cycle(total_steps, start=config.beta1_high, peak=config.beta1_low, end=config.beta1_high,
                     warmup_fraction=config.warmup_fraction)


def make_optimizer(config: config_lib.OptimizerConfig, total_steps: int, *,
                   leaf_by_leaf: bool = False) -> optax.GradientTransformation:
    """AdamW on trees with both schedules, after clipping by the global norm if `clip_norm` > 0.

    Its state is packed into two vectors (`packed`), or `leaf_by_leaf` like the parameters, which takes longer to
    compile and lets devices share it as they share the parameters.
    """
    adamw = optax.inject_hyperparams(optax.adamw, static_args=("mask",))(
        learning_rate=learning_rate(config, total_steps), b1=beta1(config, total_steps), b2=config.beta2,
        eps=config.epsilon, weight_decay=config.weight_decay, mask=decays)
    clipped = optax.chain(optax.clip_by_global_norm(config.clip_norm), adamw) if config.clip_norm > 0.0 else adamw
    clipped = _promoting(clipped)
    return clipped if leaf_by_leaf else packed(clipped)


def _promoting(inner: optax.GradientTransformation) -> optax.GradientTransformation:
    """`inner`, also where the user has JAX refuse implicit promotion of dtypes, on which optax relies."""
    def init(params):
        with jax.numpy_dtype_promotion("standard"):
            return inner.init(params)

    def update(gradients, state, params=None):
        with jax.numpy_dtype_promotion("standard"):
            return inner.update(gradients, state, params)

    return optax.GradientTransformation(init, update)


def with_constants(state: types.Array, fresh: types.Array) -> types.Array:
    """An optimiser's state with the constants of a fresh one, as the settings have them now.

    optax keeps decay, beta2 and epsilon in the state, where restored ones would win over what --resume --set says.
    """
    names = ("b2", "eps", "weight_decay")
    return optax.tree_utils.tree_set(state, **{name: optax.tree_utils.tree_get(fresh, name) for name in names})


def of_config(config: config_lib.Config) -> optax.GradientTransformation:
    """The optimiser of a run."""
    return make_optimizer(config.optimizer, config.train.steps, leaf_by_leaf=config.train.share_state)


def group_of(axes: int) -> str:
    """AdamW's group of a parameter with so many axes."""
    return "undecayed" if axes == 1 else "decayed"


def decays(params):
    """Which leaves weight decay applies to, in a tree of parameters or in the vectors of `packed`: optax's mask."""
    if isinstance(params, dict) and params.keys() <= {"decayed", "undecayed"}:
        return {name: name == "decayed" for name in params}
    return jax.tree.map(lambda leaf: group_of(leaf.ndim) == "decayed", params)


def packed(inner: optax.GradientTransformation) -> optax.GradientTransformation:
    """`inner`, which sees two vectors, as a transformation of trees; None in a tree is no leaf.

    An update of two vectors instead of hundreds of leaves compiles in a fraction of the time. The only place that
    knows of them: `inner` takes, and its state holds, {"decayed": float32 [n], "undecayed": float32 [m]}, the leaves
    of each group end to end; a group without leaves is not there (nothing empty can be saved).
    """
    def init(params):
        return inner.init(_pack(params))

    def update(gradients, state, params=None):
        updates, state = inner.update(_pack(gradients), state, None if params is None else _pack(params))
        return _unpack(updates, gradients), state

    return optax.GradientTransformation(init, update)


def norm(tree, *, leaf_by_leaf: bool = False) -> types.Array:
    """The global norm of a tree; of packed vectors it compiles faster, leaf by leaf no share moves."""
    return optax.global_norm(tree if leaf_by_leaf else _pack(tree))


def _pack(tree) -> dict[str, types.Array]:
    groups: dict[str, list[types.Array]] = {}
    for leaf in jax.tree.leaves(tree):
        groups.setdefault(group_of(leaf.ndim), []).append(leaf.reshape(-1))
    return {name: jnp.concatenate(leaves) for name, leaves in groups.items()}


def _unpack(vectors: dict[str, types.Array], like):
    """The inverse of `_pack`, as a tree of the shapes of `like`."""
    leaves, structure = jax.tree.flatten(like)
    taken = dict.fromkeys(vectors, 0)
    out = []
    for leaf in leaves:
        name = group_of(leaf.ndim)
        out.append(vectors[name][taken[name]:taken[name] + leaf.size].reshape(leaf.shape))
        taken[name] += leaf.size
    return jax.tree.unflatten(structure, out)
