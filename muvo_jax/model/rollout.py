"""Loops around the world model's two steps: filtering a window, dreaming on from a state, and decoding either.

Every random number comes from a key per sample, so that a sample's numbers depend neither on the rest of the batch nor
on the number of devices.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from muvo_jax.model.world_model import WorldModel
from muvo_jax.types import ArrayLike, Batch, Dream, LatentState, Observed, Predictions, StepNoise, Variables

Policy = Callable[[jax.Array, jax.Array], jax.Array]
_DROPOUT_SITE = 3  # the first three are those of jax.random.split(key, 3)


def sample_keys(key: jax.Array, count: int) -> jax.Array:
    """One typed key per sample [count]: fold_in(key, index), or `key` itself where it holds one key per sample already.

    Raises:
      ValueError: for raw keys or another number of keys.
    """
    if not jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key) or key.shape not in ((), (count,)):
        raise ValueError(f"got a key of dtype {key.dtype} and shape {key.shape}, expected one typed key "
                         f"(jax.random.key) or one per sample, shape ({count},).")
    return key if key.shape else _fold_each(key, count)


def draw_noise(keys: jax.Array, frames: int, shape: tuple[int, ...], prior_dropout: float = 0.0, dtype=jnp.float32, *,
               dropout: bool = False) -> StepNoise:
    """Noise for `frames` observed steps of each sample.

    Args:
      keys: typed keys [B].
      frames: T.
      shape: of the stochastic state of one sample.
      prior_dropout: probability of going on from the prior sample; 0 outside training.
      dtype: of the normal numbers.
      dropout: whether each step gets a key for dropout inside the transition.

    Returns:
      StepNoise [B, T, ...]; frame t of a sample depends on its key and on t only.
    """
    def step(key):
        key_prior, key_posterior, key_coin = jax.random.split(key, 3)
        return StepNoise(jax.random.normal(key_prior, shape, dtype), jax.random.normal(key_posterior, shape, dtype),
                         jax.random.bernoulli(key_coin, prior_dropout),
                         jax.random.fold_in(key, _DROPOUT_SITE) if dropout else None)

    return jax.vmap(jax.vmap(step))(jax.vmap(lambda key: _fold_each(key, frames))(keys))


def mean_mode(noise: StepNoise) -> StepNoise:
    """The same randomness with latents at their means: zeros for the normal numbers, no coins, dropout as it was."""
    zeros = jnp.zeros_like(noise.prior)
    return StepNoise(zeros, zeros, jnp.zeros_like(noise.use_prior), noise.dropout)


def filter_embeddings(model: WorldModel, variables: Variables, embedding: jax.Array, action: ArrayLike,
                      is_first: ArrayLike, noise: StepNoise) -> Observed:
    """Scans observe_step from the zero state over [B, T, ...]; action[t - 1] drives step t, zeros the first one."""
    previous = jnp.concatenate([jnp.zeros_like(action[:, :1]), action[:, :-1]], axis=1)

    def step(state, inputs):
        noise_t, action_t, embedding_t, is_first_t = inputs
        state, (prior, posterior) = model.observe_step(variables, noise_t, action_t, state, embedding_t, is_first_t)
        return state, (state.deterministic, prior, posterior)

    inputs = jax.tree.map(_swap_time, (noise, previous, embedding, is_first))
    _, outputs = jax.lax.scan(step, model.initial_state(embedding.shape[0]), inputs)
    deterministic, prior, posterior = jax.tree.map(_swap_time, outputs)
    return Observed(LatentState(deterministic, posterior.sample(noise.posterior)), posterior, prior)


def observe_window(model: WorldModel, variables: Variables, batch: Batch, keys: jax.Array, *, train: bool,
                   axis_name: str | None = None, sampled: bool = True) -> tuple[Observed, Variables]:
    """Encodes and filters a window; what the training step differentiates.

    Args:
      model, variables: the model.
      batch: B windows of T frames.
      keys: typed keys [B]; dropout uses fold_in(key, 0), the latents' noise fold_in(key, 1).
      train: batch statistics, dropout and the RSSM dropout are on.
      axis_name: mapped axis over which the batch is split, for BatchNorm.
      sampled: sample the latents; otherwise take their means.

    Returns:
      Observed [B, T, ...] and the (updated) batch_stats.
    """
    fold = jax.vmap(jax.random.fold_in, (0, None))
    embedding, batch_stats = model.encode(variables, batch, train=train, keys=fold(keys, 0), axis_name=axis_name)
    shape = model.initial_state(1).stochastic.shape[1:]
    noise = draw_noise(fold(keys, 1), batch.frames, shape, model.config.prior_dropout if train else 0.0, dropout=train)
    if not sampled:
        noise = mean_mode(noise)
    return filter_embeddings(model, variables, embedding, batch.action, batch.is_first, noise), batch_stats


def observe(model: WorldModel, variables: Variables, key: jax.Array, batch: Batch, *, sampled: bool = True) -> Observed:
    """Filters a batch of observed windows, in evaluation mode. Compiled once per model and shape.

    Args:
      model, variables: the model.
      key: typed key, or one per sample [B].
      batch: B windows of T frames.
      sampled: sample the latents; otherwise take their means (the key is then not used).

    Raises:
      ValueError: if the batch or the key does not fit.
    """
    batch.validate()
    return _observe(model, variables, sample_keys(key, batch.batch_size), batch, sampled)


def imagine(model: WorldModel, variables: Variables, key: jax.Array, state: LatentState,
            actions_or_policy: jax.Array | Policy, *, horizon: int | None = None, branches: int | None = None,
            sampled: bool = True) -> Dream:
    """Dreams on from states [B, ...] without observations. Compiled once per model, shapes and policy function.

    Args:
      model, variables: the model.
      key: typed key, or one per sample [B]; branch n of a sample uses fold_in(key, n), step k of it fold_in(key, k).
      state: LatentState [B, ...], for example Observed.last.
      actions_or_policy: actions [B, H, 2] or [B, N, H, 2], the first one being applied at `state`; or a policy, called
        for each sample and step as policy(key, features [D + S]) -> action [2] under vmap (features [N, 2 C] with the
        2D latent, of which WorldModel.policy_features makes one vector). Give a policy that has parameters as
        jax.tree_util.Partial(function, parameters), so that new parameters do not compile anew.
      horizon: H; needed with a policy, otherwise checked.
      branches: N futures of each state; results have the axes [B, N, H, ...]. Inferred from actions with four axes.
      sampled: sample the latents; otherwise take their means.

    Raises:
      ValueError: if shapes, horizon, branches or key do not fit together.
    """
    batch_size = state.deterministic.shape[0]
    keys = sample_keys(key, batch_size)
    driver: jax.Array | jax.tree_util.Partial
    if callable(actions_or_policy):
        if horizon is None:
            raise ValueError("imagine: a policy needs a horizon; pass horizon=number of steps.")
        policy = actions_or_policy
        driver = policy if isinstance(policy, jax.tree_util.Partial) else jax.tree_util.Partial(policy)
    else:
        driver = actions = jnp.asarray(actions_or_policy)
        branches, horizon = _check_actions(actions, batch_size, horizon, branches)
    return _imagine(model, variables, keys, state, driver, horizon, branches, sampled)


def decode(model: WorldModel, variables: Variables, states: LatentState | Dream | jax.Array,
           heads: Sequence[str] | None = None) -> Predictions:
    """Decodes latent states (or their features) with any leading axes; see WorldModel.decode."""
    features = states if isinstance(states, jax.Array) else states.features
    return _decode(model, variables, features, None if heads is None else tuple(heads))


def learned_policy(model: WorldModel, variables: Variables) -> Policy:
    """The model's own action head as a policy for `imagine`: the driver of the training data, cloned."""
    return jax.tree_util.Partial(functools.partial(_decode_action, model), variables)


def _decode_action(model, variables, key, features):
    del key
    return model.decode(variables, features, ("action",))["action"][1]


def _check_actions(actions, batch_size, horizon, branches):
    """Returns (branches, horizon) as the actions imply them."""
    if actions.ndim not in (3, 4) or actions.shape[0] != batch_size or actions.shape[-1] != 2:
        raise ValueError(f"imagine: got actions {list(actions.shape)}, expected [{batch_size}, H, 2] or "
                         f"[{batch_size}, N, H, 2].")
    if horizon is not None and horizon != actions.shape[-2]:
        raise ValueError(f"imagine: horizon={horizon}, but there are {actions.shape[-2]} actions; leave horizon out.")
    if actions.ndim == 4 and branches not in (None, actions.shape[1]):
        raise ValueError(f"imagine: branches={branches}, but the actions have {actions.shape[1]}; leave branches out.")
    return (actions.shape[1] if actions.ndim == 4 else branches), actions.shape[-2]


def _fold_each(key, count):
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(count))


def _swap_time(leaf):
    return jnp.swapaxes(leaf, 0, 1)


@functools.partial(jax.jit, static_argnames=("model", "sampled"))
def _observe(model, variables, keys, batch, sampled):
    return observe_window(model, variables, batch, keys, train=False, sampled=sampled)[0]


@functools.partial(jax.jit, static_argnames=("model", "heads"))
def _decode(model, variables, features, heads):
    return model.decode(variables, features, heads)


@functools.partial(jax.jit, static_argnames=("model", "horizon", "branches", "sampled"))
def _imagine(model, variables, keys, state, driver, horizon, branches, sampled):
    """Merges branches into the batch, scans, and parts them again."""
    if branches is None:
        return _imagine_flat(model, variables, keys, state, driver, horizon, sampled)
    batch_size = keys.shape[0]
    spread = lambda leaf: jnp.repeat(leaf, branches, axis=0)
    merge = lambda leaf: leaf.reshape(batch_size * branches, *leaf.shape[2:])
    keys = merge(jax.vmap(lambda key: _fold_each(key, branches))(keys))
    if not callable(driver):
        driver = merge(driver) if driver.ndim == 4 else spread(driver)
    dream = _imagine_flat(model, variables, keys, jax.tree.map(spread, state), driver, horizon, sampled)
    return jax.tree.map(lambda leaf: leaf.reshape(batch_size, branches, *leaf.shape[1:]), dream)


def _imagine_flat(model, variables, keys, state, driver, horizon, sampled):
    shape = state.stochastic.shape[1:]

    def step(state, inputs):
        index, action = inputs
        step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, index)
        if callable(driver):
            action = jax.vmap(driver)(jax.vmap(jax.random.fold_in, (0, None))(step_keys, 1), state.features)
        if sampled:
            noise = jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, 0), shape))(step_keys)
        else:
            noise = jnp.zeros_like(state.stochastic)
        state, prior = model.imagine_step(variables, noise, action, state)
        return state, (state, action, prior)

    actions = None if callable(driver) else _swap_time(driver)
    _, outputs = jax.lax.scan(step, state, (jnp.arange(horizon), actions))
    states, actions, prior = jax.tree.map(_swap_time, outputs)
    return Dream(states, actions, prior)
