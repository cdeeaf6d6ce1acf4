"""Loops around the world model's two steps: filtering a window, dreaming on from a state, and decoding either.

Every random number comes from a key per sample, so that a sample's numbers depend neither on the rest of the batch nor
on the number of devices.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from muvo_jax.model import checks
from muvo_jax.model import memory as memory_lib
from muvo_jax.model.world_model import WorldModel
from muvo_jax.nn import layers
from muvo_jax.types import ArrayLike, Batch, Dream, LatentState, Memory, Observed, Predictions, StepNoise, Variables

Policy = Callable[[jax.Array, jax.Array], jax.Array]
_DROPOUT_SITE = 3  # the first three are those of jax.random.split(key, 3)


def sample_keys(key: jax.Array, count: int) -> jax.Array:
    """One typed key per sample [count]: fold_in(key, index), or `key` itself where it holds one key per sample already.

    Raises:
      ValueError: for what is no key, raw keys or another number of keys.
    """
    if not isinstance(key, jax.Array):
        raise ValueError(f"got the key {key!r:.100}, expected one typed key (jax.random.key) or one per sample, shape "
                         f"({count},).")
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
    draw = lambda key: frame_noise(key, shape, prior_dropout, dtype, dropout=dropout)
    return jax.vmap(jax.vmap(draw))(jax.vmap(lambda key: _fold_each(key, frames))(keys))


def frame_noise(key: jax.Array, shape: tuple[int, ...], prior_dropout: float = 0.0, dtype=jnp.float32, *,
                dropout: bool = False) -> StepNoise:
    """The noise of one sample's observed frame, whose key is fold_in(the sample's, t); see draw_noise."""
    key_prior, key_posterior, key_coin = jax.random.split(key, 3)
    return StepNoise(jax.random.normal(key_prior, shape, dtype), jax.random.normal(key_posterior, shape, dtype),
                     jax.random.bernoulli(key_coin, prior_dropout),
                     jax.random.fold_in(key, _DROPOUT_SITE) if dropout else None)


def mean_mode(noise: StepNoise) -> StepNoise:
    """The same randomness with latents at their means: zeros for the normal numbers, no coins, dropout as it was."""
    zeros = jnp.zeros_like(noise.prior)
    return StepNoise(zeros, zeros, jnp.zeros_like(noise.use_prior), noise.dropout)


def filter_embeddings(model: WorldModel, variables: Variables, embedding: jax.Array, action: ArrayLike,
                      is_first: ArrayLike, noise: StepNoise, speed_mps: ArrayLike | None = None, *,
                      remat: bool = False) -> Observed:
    """Scans observe_step from the zero state over [B, T, ...]; action[t - 1] drives step t, zeros the first one.

    speed_mps: [B, T], for a model that tracks its motion. Vantages and memory are left to memory.of_window.
    remat: whether the gradients compute each step again instead of keeping all of it.
    """
    previous = jnp.concatenate([jnp.zeros_like(action[:, :1]), action[:, :-1]], axis=1)

    def step(state, inputs):
        noise_t, action_t, embedding_t, is_first_t, speed_t = inputs
        state, (prior, posterior) = model.observe_step(variables, noise_t, state, action_t, embedding_t, is_first_t)
        deterministic = state.deterministic
        if speed_t is not None:
            motion = dataclasses.replace(state.vantage.motion, speed_mps=speed_t)
            state = dataclasses.replace(state, vantage=dataclasses.replace(state.vantage, motion=motion))
        return state, (deterministic, prior, posterior)

    inputs = jax.tree.map(_swap_time, (noise, previous, embedding, is_first, speed_mps))
    scanned = jax.checkpoint(step, prevent_cse=False) if remat else step
    _, outputs = jax.lax.scan(scanned, layers.varying_as(model.initial_state(embedding.shape[0]), inputs), inputs)
    deterministic, prior, posterior = jax.tree.map(_swap_time, outputs)
    return Observed(LatentState(deterministic, posterior.sample(noise.posterior)), posterior, prior)


def observe_window(model: WorldModel, variables: Variables, batch: Batch, keys: jax.Array, *, train: bool,
                   axis_name: str | None = None, sampled: bool = True,
                   remat: bool = False) -> tuple[Observed, Variables]:
    """Encodes and filters a window; what the training step differentiates.

    Args:
      model, variables: the model.
      batch: B windows of T frames.
      keys: typed keys [B]; dropout uses fold_in(key, 0), the latents' noise fold_in(key, 1).
      train: batch statistics, dropout and the RSSM dropout are on.
      axis_name: mapped axis over which the batch is split, for BatchNorm.
      sampled: sample the latents; otherwise take their means.
      remat: whether the gradients compute the steps of the filter again.

    Returns:
      Observed [B, T, ...] and the (updated) batch_stats.
    """
    fold = jax.vmap(jax.random.fold_in, (0, None))
    embedding, batch_stats = model.encode(variables, batch, train=train, keys=fold(keys, 0), axis_name=axis_name)
    shape = model.initial_state(1).stochastic.shape[1:]
    noise = draw_noise(fold(keys, 1), batch.frames, shape, model.config.prior_dropout if train else 0.0, dropout=train)
    if not sampled:
        noise = mean_mode(noise)
    moved = memory_lib.measured(model.config, batch) if model.config.tracks_motion else None
    observed = filter_embeddings(model, variables, embedding, batch.action, batch.is_first, noise,
                                 None if moved is None else moved.speed_mps, remat=remat)
    if model.config.tracks_motion:
        moved = moved or memory_lib.from_arrivals(model.ego_motion(variables, observed.states), batch.is_first)
        states, remembered = memory_lib.of_window(model.config, batch, observed.states, moved)
        observed = dataclasses.replace(observed, states=states, memory=remembered)
    return observed, batch_stats


def observe(model: WorldModel, variables: Variables, key: jax.Array, batch: Batch, *, sampled: bool = True) -> Observed:
    """Filters a batch of observed windows, in evaluation mode. Compiled once per model and shape.

    Args:
      model, variables: the model.
      key: typed key, or one per sample [B].
      batch: B windows of T frames.
      sampled: sample the latents; otherwise take their means (the key is then not used).

    Raises:
      ValueError: if the batch or the key does not fit, or a concrete input is not finite.
      TypeError: for forward-mode derivatives through convolutions that have none (ModelConfig.convolution).
    """
    batch.validate()
    checks.observation("observe", model, batch)
    checks.forward_mode("observe", model, variables, batch)
    keys = sample_keys(key, batch.batch_size)
    return _observe_window(model, variables, batch, keys, train=False, sampled=sampled)[0]


def imagine(model: WorldModel, variables: Variables, key: jax.Array, state: LatentState,
            actions_or_policy: ArrayLike | Policy, *, horizon: int | None = None, branches: int | None = None,
            sampled: bool = True, temperature: float | jax.Array = 1.0, same_noise: bool = False) -> Dream:
    """Dreams on from latent states without observations. Compiled once per model, shapes and policy function.

    `jit`, `vmap`, `shard_map`, `grad` and `jvp` work from outside. Shapes and keys are always checked, the values of
    actions where they are concrete (not traced), all before anything is compiled. Nothing is decoded; see `decode`.

    Args:
      model, variables: the model.
      key: typed key, or one per state [*L]; branch n of a state uses fold_in(key, n), step k of it fold_in(key, k).
      state: LatentState [*L, ...] with any leading axes: [B] as in Observed.last, [B, T] as in Observed.states (a dream
        from every frame of a window), or none.
      actions_or_policy: actions [*L, H, 2] or [*L, N, H, 2] in [-1, 1], the first one being applied at `state`; or a
        policy, called for each state and step as policy(key, features [D + S]) -> action [2] under vmap (features
        [N, 2 C] with the 2D latent, of which WorldModel.policy_features makes one vector); what it returns is clipped
        to [-1, 1]. Give a policy that has parameters as jax.tree_util.Partial(function, parameters), so that new
        parameters do not compile anew.
      horizon: H; needed with a policy, otherwise checked.
      branches: N futures of each state; results have the axes [*L, N, H, ...]. Inferred from actions that have them.
      sampled: sample the latents; otherwise take their means.
      temperature: factor on the standard deviation of the latents where sampled, one number; may be traced.
      same_noise: all branches of a state draw the same noise, so that they differ by their actions alone.

    Raises:
      ValueError: if shapes, values, horizon, branches or key do not fit; the message names what came. Also where a
        policy chose what is no number, naming the step.
    """
    lead = checks.state(model, state)
    count = math.prod(lead)
    keys = _keys_of(key, lead)
    driver: jax.Array | jax.tree_util.Partial
    if callable(actions_or_policy):
        policy = actions_or_policy
        driver = policy if isinstance(policy, jax.tree_util.Partial) else jax.tree_util.Partial(policy)
    else:
        driver = jnp.asarray(actions_or_policy, jnp.float32)
        branches, horizon = checks.actions(actions_or_policy, lead, horizon, branches)
        driver = driver.reshape(count, *driver.shape[len(lead):])
    horizon = checks.counts(horizon, branches)
    checks.scalar("imagine", temperature=temperature)
    checks.finite("imagine", state=state, temperature=temperature)
    flat = jax.tree.map(lambda leaf: leaf.reshape(count, *leaf.shape[len(lead):]), state)
    dream = _imagine(model, variables, keys, flat, driver, jnp.float32(temperature), horizon, branches, sampled,
                     same_noise)
    if callable(driver):
        checks.chosen_actions(dream.actions, "imagine")
    return jax.tree.map(lambda leaf: leaf.reshape(*lead, *leaf.shape[1:]), dream)


def imagine_step(model: WorldModel, variables: Variables, key: jax.Array, state: LatentState, action: ArrayLike, *,
                 sampled: bool = True, temperature: float | jax.Array = 1.0) -> LatentState:
    """One step of `imagine`: where an action leads. What a search over a tree calls; compiled once per model and shape.

    Args:
      model, variables: the model.
      key: typed key, of which state i of all takes fold_in(key, i), or one per state [*L], taken as it is.
      state: LatentState [*L, ...] with any leading axes.
      action: [*L, 2] in [-1, 1], applied at `state`; values that lie on a device are clipped, not looked at.
      sampled, temperature: as in `imagine`.

    Returns:
      LatentState [*L, ...]. It is step k of the `imagine` whose key for the state is a, given the key
      fold_in(fold_in(a, k), 0).

    Raises:
      ValueError: if shapes, values or key do not fit.
    """
    lead = checks.state(model, state)
    action = checks.one_action(action, lead, "imagine_step")
    checks.scalar("imagine_step", temperature=temperature)
    checks.finite_on_host("imagine_step", state=state, temperature=temperature)
    keys = _keys_of(key, lead)
    flat = jax.tree.map(lambda leaf: leaf.reshape(len(keys), *leaf.shape[len(lead):]), state)
    after = _imagine_one(model, variables, keys, flat, action.reshape(len(keys), -1), jnp.float32(temperature), sampled)
    return jax.tree.map(lambda leaf: leaf.reshape(*lead, *leaf.shape[1:]), after)


def decode(model: WorldModel, variables: Variables, states: LatentState | Dream | jax.Array,
           heads: Sequence[str] | None = None, *, memory: Memory | None = None,
           rows: ArrayLike | None = None) -> Predictions:
    """Decodes latent states (or their features) with any leading axes; see WorldModel.decode.

    A model with first_guess="last_seen" needs the `memory` of the drives too: Observed.memory or LiveState.memory.

    Raises:
      ValueError: for heads that are one name, or concrete states that the memory's evidence does not hold for
        (memory.with_evidence).
      TypeError: for forward-mode derivatives through convolutions that have none (ModelConfig.convolution).
    """
    states = states.states if isinstance(states, Dream) else states
    if isinstance(heads, str):
        raise ValueError(f"decode: heads is {heads!r}; expected a sequence of names, ({heads!r},).")
    if isinstance(states, LatentState):
        memory_lib.check_evidence(states, memory)
    checks.forward_mode("decode", model, variables, states, memory)
    return _decode(model, variables, states, None if heads is None else tuple(heads), memory, rows)


def learned_policy(model: WorldModel, variables: Variables) -> Policy:
    """The model's own action head as a policy for `imagine`: the driver of the training data, cloned.

    Policies of one model are one function with other variables: none compiles anew.
    """
    return jax.tree_util.Partial(_ActionHead(model), variables)


@dataclasses.dataclass(frozen=True)
class _ActionHead:
    """Compares by its model, as a closure or functools.partial would not."""

    model: WorldModel

    def __call__(self, variables, key, features):
        del key
        return self.model.decode(variables, features, ("action",)).action


def _keys_of(key, lead):
    """One key per state of the leading axes, flat."""
    return sample_keys(key.reshape(-1) if lead and getattr(key, "shape", None) == lead else key, math.prod(lead))


def _fold_each(key, count):
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(count))


def _swap_time(leaf):
    return jnp.swapaxes(leaf, 0, 1)


_observe_window = jax.jit(observe_window, static_argnames=("model", "train", "sampled"))


@functools.partial(jax.jit, static_argnames=("model", "heads"))
def _decode(model, variables, states, heads, memory, rows):
    return model.decode(variables, states, heads, memory, rows)


@functools.partial(jax.jit, static_argnames=("model", "sampled"))
def _imagine_one(model, variables, keys, state, action, temperature, sampled):
    return _advance(model, variables, keys, state, action, temperature if sampled else None)[0]


@functools.partial(jax.jit, static_argnames=("model", "horizon", "branches", "sampled", "same_noise"))
def _imagine(model, variables, keys, state, driver, temperature, horizon, branches, sampled, same_noise):
    """Merges branches into the batch, scans, and parts them again."""
    walk = functools.partial(_imagine_flat, model, variables, temperature=temperature if sampled else None,
                             horizon=horizon)
    if branches is None:
        return walk(keys, keys, state, driver)
    batch_size = keys.shape[0]
    spread = lambda leaf: jnp.repeat(leaf, branches, axis=0)
    merge = lambda leaf: leaf.reshape(batch_size * branches, *leaf.shape[2:])
    branch_keys = merge(jax.vmap(lambda key: _fold_each(key, branches))(keys))
    if not callable(driver):
        driver = merge(driver) if driver.ndim == 4 else spread(driver)
    dream = walk(spread(keys) if same_noise else branch_keys, branch_keys, jax.tree.map(spread, state), driver)
    return jax.tree.map(lambda leaf: leaf.reshape(batch_size, branches, *leaf.shape[1:]), dream)


def _advance(model, variables, keys, state, action, temperature):
    """One imagined step of states [B, ...] under noise from their keys; at the mean where temperature is None."""
    noise = jnp.zeros_like(state.stochastic)
    if temperature is not None:
        shape = state.stochastic.shape[1:]
        noise = temperature * jax.vmap(lambda key: jax.random.normal(key, shape, jnp.float32))(keys)
    return model.imagine_step(variables, noise, state, action)


def _imagine_flat(model, variables, keys_noise, keys_policy, state, driver, *, temperature, horizon):
    fold = jax.vmap(jax.random.fold_in, (0, None))

    def step(state, inputs):
        index, action = inputs
        if callable(driver):
            keys = fold(fold(keys_policy, index), 1)
            action = checks.policy_action(jax.vmap(driver)(keys, state.features), state.features)
        state, prior = _advance(model, variables, fold(fold(keys_noise, index), 0), state, action, temperature)
        return state, (state, action, prior)

    actions = None if callable(driver) else _swap_time(driver)
    state = layers.varying_as(state, (keys_noise, keys_policy, driver, temperature))
    _, outputs = jax.lax.scan(step, state, (jnp.arange(horizon), actions))
    states, actions, prior = jax.tree.map(_swap_time, outputs)
    return Dream(states, actions, prior)
