"""The one training step: losses, gradients and update in a single compiled function, on one device or on many.

Gradient accumulation runs micro-batches one after the other and averages their gradients. BatchNorm moments, SCAL
ratios and every other mean are those of one micro-batch (over all devices), as in the reference: 16 micro-batches of
one window are not one batch of 16 windows.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax

from muvo_jax import config as config_lib
from muvo_jax import types
from muvo_jax.model import rollout, world_model
from muvo_jax.objectives import perceptual, total
from muvo_jax.training import augmentation, light, mirror, scoring, trainable
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import parallel as parallel_lib
from muvo_jax.training import state as state_lib

Metrics = dict[str, types.Array]
# Separate these draws from all others made with the same sample key.
_DECODE_SITE, _IMAGINE_SITE, _RESTART_SITE = 0xDEC0, 0x1A61, 0x2E57
_VALIDATION_STEP = 2**31 - 1  # folded into the key where training folds its step in; no run gets there


@dataclasses.dataclass(frozen=True)
class SpreadFunction:
    """A compiled function of a state and a batch that puts both where they belong.

    Attributes:
      plan: devices and mode.
      accumulate: micro-batches in a batch.
      compiled: from `parallel.spread`.
    """

    plan: parallel_lib.Plan
    accumulate: int
    compiled: Callable[[Any, types.Batch], Any]

    def place(self, batch: types.Batch) -> types.Batch:
        """Splits and uploads a batch; a prefetch thread may do so ahead of the call."""
        return parallel_lib.place_batch(self.plan, batch, self.accumulate)

    def __call__(self, state: state_lib.TrainState, batch: types.Batch) -> Any:
        """Runs on leaves [accumulate * B, ...], or on what `place` made of them."""
        placed = batch if batch.action.ndim > 3 else self.place(batch)
        return self.compiled(parallel_lib.place_state(self.plan, state), placed)


def make_train_step(model: world_model.WorldModel, config: config_lib.Config, *, parallel: str | None = None,
                    devices: Sequence[jax.Device] | None = None,
                    frozen: perceptual.FrozenEncoder | None = None) -> SpreadFunction:
    """Builds function(state, batch) -> (state, metrics); the state that goes in is donated.

    The metrics are float32 scalars: every loss term (unweighted), "total", "psnr_db" of the decoded images
    (imagined ones among them where config.train.observe_frames leaves some), "learning_rate", the norms
    "gradient_norm", "parameter_norm", "update_norm" of what trains, and "finite" (1 or 0).
    Where loss or gradients are not finite nothing is applied, so the parameters stay usable ("update_norm" is 0, the
    rate that of the update before); the step is counted. An update that is not finite although they are changes the
    optimiser's state alone ("update_norm" says what it was).

    Args:
      model: what is trained.
      config: losses, optimiser, batch and accumulation.
      parallel: "auto", "pmap" or "shard_map"; by default config.train.parallel.
      devices: by default all.
      frozen: the network of the perceptual term, where that is on.

    Raises:
      ValueError: for augmentation.mirror with sensors or route maps that are not symmetric.
    """
    if config.augmentation.mirror:
        mirror.check(config)
    optimizer = optimizer_lib.of_config(config)
    norm = functools.partial(optimizer_lib.norm, leaf_by_leaf=config.train.share_state)
    gradients_of = gradient_body(model, config, frozen)

    def split(params):
        return trainable.split(params, trainable.chosen(params, config.train.trainable))

    def update(state, found):
        gradients, batch_stats, metrics = found
        trained, frozen_params = split(state.params)
        gradient_norm = norm(gradients)
        finite = jnp.isfinite(metrics["total"]) & jnp.isfinite(gradient_norm)

        def updated():
            updates, opt_state = optimizer.update(gradients, state.opt_state, trained)
            norms = {"parameter_norm": norm(trained), "update_norm": norm(updates)}
            # Gradients are finite here, and so are the moments that they enter, but their quotient may not be. The old
            # moments are not kept: that would cost a copy of them in every step.
            sound = jnp.isfinite(norms["update_norm"])
            after, before = (optax.apply_updates(trained, updates), batch_stats), (trained, state.batch_stats)
            return (*jax.tree.map(lambda new, old: jnp.where(sound, new, old), after, before), opt_state), norms

        def kept():
            return (trained, state.batch_stats, state.opt_state), {"parameter_norm": norm(trained),
                                                                   "update_norm": jnp.float32(0.0)}

        # A branch, because XLA does all in it after the gradients. Outside it copies the moments and packs the
        # parameters as soon as it can, at the start of the step, and keeps the copies through all of it.
        (params, batch_stats_after, opt_state), norms = jax.lax.cond(finite, updated, kept)
        metrics |= {"learning_rate": _applied_rate(opt_state), "gradient_norm": gradient_norm,
                    "finite": (finite & jnp.isfinite(norms["update_norm"])).astype(jnp.float32)} | norms
        return state.replace(step=state.step + 1, params=trainable.merge(params, frozen_params),
                             batch_stats=batch_stats_after, opt_state=opt_state), metrics

    plan = parallel_lib.make_plan(parallel or config.train.parallel, config.train.batch, devices,
                                  share_state=config.train.share_state)
    spread = parallel_lib.spread(plan, gradients_of, then=update, shared=lambda state: split(state.params)[0],
                                 donate_state=True)
    return SpreadFunction(plan, config.optimizer.accumulate, spread)


def _applied_rate(opt_state: Any) -> types.Array:
    """Of the last update. `TrainState.step` does not tell it: that counts skipped steps too, the optimiser does not."""
    is_value = lambda path, value: isinstance(value, jax.Array)  # beside it lies the state of its schedule
    return optax.tree_utils.tree_get(opt_state, "learning_rate", filtering=is_value)


def make_validation_step(model: world_model.WorldModel, config: config_lib.Config, *, batch_size: int | None = None,
                         parallel: str | None = None, devices: Sequence[jax.Device] | None = None,
                         frozen: perceptual.FrozenEncoder | None = None) -> SpreadFunction:
    """Builds function(state, batch) -> metrics: the loss terms and "psnr_db" without dropout, on running statistics.

    The latents are sampled with keys that depend on the run's key and the place in the batch, not on the step, so that
    the numbers of two steps compare.

    Args:
      model, config, parallel, devices, frozen: as `make_train_step`.
      batch_size: windows per call; by default config.train.batch.
    """
    def body(state, batch, axis_name):
        windows = batch[0]  # a single micro-batch
        keys = sample_keys(state.key, _VALIDATION_STEP, 0, windows.batch_size, axis_name)
        _, (metrics, _) = forward(state.params, state.batch_stats, windows, keys, model=model, config=config,
                                  train=False, axis_name=axis_name, frozen=frozen)
        return metrics

    plan = parallel_lib.make_plan(parallel or config.train.parallel, batch_size or config.train.batch, devices)
    return SpreadFunction(plan, 1, parallel_lib.spread(plan, body))


def gradient_body(model: world_model.WorldModel, config: config_lib.Config,
                  frozen: perceptual.FrozenEncoder | None = None) -> Callable:
    """Returns body(state, batch [accumulate, b, ...], axis_name) -> (gradients, batch_stats, metrics).

    The gradients are a tree like the parameters, None where `config.train.trainable` freezes one. Gradients and
    metrics are means over micro-batches, equal on all devices (with `config.train.share_state` each device has its
    share of the gradients); running statistics pass through the micro-batches in order.
    """
    def scored(trained, rest, *inputs, axis_name):
        return forward(trainable.merge(trained, rest), *inputs, model=model, config=config, train=True,
                       axis_name=axis_name, frozen=frozen)

    differentiate = jax.value_and_grad(scored, has_aux=True)

    def micro_step(state, batch_stats, batch, index, axis_name):
        keys = sample_keys(state.key, state.step, index, batch.batch_size, axis_name)
        trains = trainable.chosen(state.params, config.train.trainable)
        with trainable.frozen_norms(trains):
            (_, (metrics, batch_stats)), gradients = differentiate(
                *trainable.split(state.params, trains), batch_stats, batch, keys, axis_name=axis_name)
        gradients = parallel_lib.mean_gradients(gradients, axis_name, config.train.share_state)
        return batch_stats, gradients, metrics

    def body(state, batch, axis_name):
        count = config.optimizer.accumulate
        if count == 1:
            batch_stats, gradients, metrics = micro_step(state, state.batch_stats, batch[0], 0, axis_name)
            return gradients, batch_stats, metrics

        def scanned(carry, inputs):
            (batch_stats, sums), (micro_batch, index) = carry, inputs
            batch_stats, *more = micro_step(state, batch_stats, micro_batch, index, axis_name)
            return (batch_stats, jax.tree.map(jnp.add, sums, more)), None

        _, *shapes = jax.eval_shape(lambda: micro_step(state, state.batch_stats, batch[0], 0, axis_name))
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        (batch_stats, sums), _ = jax.lax.scan(scanned, (state.batch_stats, zeros), (batch, jnp.arange(count)))
        gradients, metrics = jax.tree.map(lambda value: value / count, sums)
        return gradients, batch_stats, metrics

    return body


def sample_keys(run_key: types.Array, step: int | types.Array, micro_batch: int | types.Array, local_size: int,
                axis_name: str | None) -> types.Array:
    """Typed keys [b], one per window: fold_in(fold_in(run_key, step), place of the window in the whole batch).

    The place counts over micro-batches and devices, so the randomness does not depend on how many devices there are.
    """
    device, devices = (0, 1) if axis_name is None else (jax.lax.axis_index(axis_name), jax.lax.axis_size(axis_name))
    first = (micro_batch * devices + device) * local_size
    step_key = jax.random.fold_in(run_key, step)
    return jax.vmap(lambda index: jax.random.fold_in(step_key, index))(first + jnp.arange(local_size))


def forward(params: Any, batch_stats: Any, batch: types.Batch, keys: types.Array, *, model: world_model.WorldModel,
            config: config_lib.Config, train: bool, axis_name: str | None,
            frozen: perceptual.FrozenEncoder | None = None) -> tuple[types.Array, tuple[Metrics, Any]]:
    """Observes a window, decodes its frames (in training those that the config asks for) and scores them.

    Args:
      params, batch_stats: the model's variables.
      batch: the local windows, leaves [b, T, ...].
      keys: typed keys [b].
      model, config: what to compute.
      train: augmentation, dropout, prior dropout and batch moments; otherwise none of them and running moments.
      axis_name: mesh axis the batch is spread over, or None.
      frozen: the network of the perceptual term, where that is on.

    Returns:
      The total loss of the whole batch, and (metrics, new batch_stats).
    """
    if train and config.augmentation.mirror:
        batch = mirror.randomly(batch, keys)
    if train and config.augmentation.light:
        batch = light.randomly(batch, keys)
    variables = {"params": params, "batch_stats": batch_stats}
    seen = min(config.train.observe_frames or batch.frames, batch.frames) if train else batch.frames
    shown = batch.time_slice(0, seen)
    if train:
        shown = augmentation.augment(shown, keys, config.augmentation)
        if config.train.restart:
            batch = dataclasses.replace(batch, is_first=_restarted(batch.is_first, keys, seen))
            shown = dataclasses.replace(shown, is_first=batch.is_first[:, :seen])
    observed, batch_stats = rollout.observe_window(model, variables, shown, keys, train=train, axis_name=axis_name,
                                                   remat=config.train.remat == "frames")
    states, memory = observed.states, observed.memory
    if memory is not None and memory.image is not None:  # not augmented: the target is not either
        memory = dataclasses.replace(memory, image=jnp.asarray(batch.image)[:, :seen])
    if train:
        states = _and_imagined(model, variables, observed, batch.action, keys)
        states, batch = _some_frames(states, batch, keys, config.train.decode_frames)
    sums = total.kl_sums(observed, model=model.config, loss=config.loss) | scoring.sums(
        model, variables, states, memory, batch, keys, config=config, frozen=frozen,
        one_by_one=train and config.train.remat != "none")
    if axis_name is not None:
        sums = jax.lax.psum(sums, axis_name)
    beside = sums.pop(scoring.PSNR).terms(scoring.PSNR) if scoring.PSNR in sums else {}
    terms = total.combine(sums, total.term_weights(config.loss, model.config.heads))
    return terms["total"], (terms | beside, batch_stats)


def _and_imagined(model: world_model.WorldModel, variables: types.Variables, observed: types.Observed,
                  action: types.ArrayLike, keys: types.Array) -> types.LatentState:
    """States of all frames of a window: the observed ones, then those that follow from the last one's state.

    The loss of a decoded frame then also teaches prediction over several steps, beside the KL divergence over one.
    """
    seen = observed.states.deterministic.shape[1]
    if seen == action.shape[1]:
        return observed.states
    dream_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, _IMAGINE_SITE)
    dream = rollout.imagine(model, variables, dream_keys, observed.last, action[:, seen - 1:-1])
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), observed.states, dream.states)


def _restarted(is_first: types.ArrayLike, keys: types.Array, seen: int) -> types.Array:
    """bool [B, T]: each window is cut in two at one of its `seen` observed frames, drawn anew (or not, at the first).

    So the last observed state has seen 1 to `seen` frames, and a dream starts from any of these. The losses are told
    too: at the cut no motion since the frame before is to be known.
    """
    at = jax.vmap(lambda key: jax.random.randint(jax.random.fold_in(key, _RESTART_SITE), (), 0, seen))(keys)
    return jnp.asarray(is_first) | (jnp.arange(is_first.shape[1])[None] == at[:, None])


def _some_frames(states: types.LatentState, batch: types.Batch, keys: types.Array,
                 count: int) -> tuple[types.LatentState, types.Batch]:
    """Of each window the `count` frames that are decoded, drawn anew in every step; 0 or T and more take all of them.

    Neighbouring frames look alike: decoding a few of more windows teaches more at the same cost.
    """
    if count == 0 or count >= batch.frames:
        return states, batch
    draw = lambda key: jax.random.permutation(jax.random.fold_in(key, _DECODE_SITE), batch.frames)[:count]
    chosen = jax.vmap(draw)(keys)
    pick = jax.vmap(lambda leaf, index: leaf[index])
    return jax.tree.map(lambda leaf: pick(leaf, chosen), states), batch.map_frames(lambda leaf: pick(leaf, chosen))
