"""Planning over action sequences in imagination: CEM and iCEM, MPPI, and gradient ascent. All of them jit end to end.

A planner maximises `objective(key, plans [P, H, 2]) -> returns [P]`, for example `imagined_returns` of an environment,
and starts from a plan [H, 2], zeros or the last plan shifted by one step (`shift`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
import optax

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import rewards
from muvo_jax.limits import COUNT, NOT_NEGATIVE, SHARE, above, check
from muvo_jax.model import checks
from muvo_jax.ops import motion as motion_ops
from muvo_jax.ops import precision
from muvo_jax.types import Array

Objective = Callable[[Array, Array], Array]


@dataclasses.dataclass(frozen=True)
class PlannerConfig:
    """Settings of all planners; each reads what it needs.

    Attributes:
      plans: P, candidates per iteration.
      iterations: refinements.
      elites: the best ones, to which CEM fits its Gaussian.
      kept: elites that iCEM carries on to the next iteration (0: plain CEM).
      noise_exponent: iCEM draws noise with power 1 / f**exponent over time; 0 is white (plain CEM).
      std: first standard deviation of both action channels.
      smoothing: share of the old mean and deviation that stays.
      temperature: of MPPI's weights exp(return / temperature), in units of return.
      starts: plans that gradient planning ascends from, the given one and others in coloured noise around it.
      learning_rate: of gradient planning (Adam).
    """

    plans: Annotated[int, COUNT] = 64
    iterations: Annotated[int, COUNT] = 4
    elites: Annotated[int, COUNT] = 8
    kept: Annotated[int, NOT_NEGATIVE] = 3
    noise_exponent: Annotated[float, NOT_NEGATIVE] = 2.0
    std: Annotated[float, above(0)] = 0.5
    smoothing: Annotated[float, SHARE] = 0.1
    temperature: Annotated[float, above(0)] = 0.5
    starts: Annotated[int, COUNT] = 8
    learning_rate: Annotated[float, above(0)] = 0.1

    def __post_init__(self):
        check(self)
        if not self.kept <= self.elites <= self.plans:
            raise ValueError(f"PlannerConfig: expected kept <= elites <= plans; got kept={self.kept}, "
                             f"elites={self.elites}, plans={self.plans}.")


@flax.struct.dataclass
class Plan:
    """The result: actions [H, 2] in [-1, 1] and the return expected of them."""

    actions: Array
    value: Array


def cem(objective: Objective, key: Array, start: Array, config: PlannerConfig = PlannerConfig()) -> Plan:
    """The cross-entropy method; with `kept` and `noise_exponent` its improved form (Pinneri et al. 2020).

    Returns the best plan seen.
    """
    start = jnp.clip(_checked(start), -1.0, 1.0)
    horizon, channels = start.shape

    def iterate(carry, key):
        mean, std, elites, elite_values, best = carry
        key_noise, key_value = jax.random.split(key)
        noise = coloured_noise(key_noise, (config.plans, horizon, channels), config.noise_exponent)
        plans = jnp.clip(mean[None] + std[None] * noise, -1.0, 1.0).at[0].set(mean)
        values = jnp.concatenate([_finite(objective(key_value, plans)), elite_values[:config.kept]])
        plans = jnp.concatenate([plans, elites[:config.kept]])
        elite_values, index = jax.lax.top_k(values, config.elites)
        elites = plans[index]
        blend = lambda old, new: config.smoothing * old + (1.0 - config.smoothing) * new
        return (blend(mean, elites.mean(axis=0)), blend(std, elites.std(axis=0)), elites, elite_values,
                _better(best, plans, values)), None

    first = (start, jnp.full_like(start, config.std),
             jnp.zeros((config.elites, horizon, channels), jnp.float32),
             jnp.full((config.elites,), -jnp.inf, jnp.float32), Plan(start, jnp.float32(-jnp.inf)))
    (*_, best), _ = jax.lax.scan(iterate, first, jax.random.split(key, config.iterations))
    return best


def mppi(objective: Objective, key: Array, start: Array, config: PlannerConfig = PlannerConfig()) -> Plan:
    """Model-predictive path integral control: the mean of all plans, weighted by exp(return / temperature).

    Where no plan has a finite return, the mean stays as it is.
    """
    start = _checked(start)

    def iterate(mean, key):
        key_noise, key_value = jax.random.split(key)
        noise = config.std * jax.random.normal(key_noise, (config.plans, *start.shape), jnp.float32)
        plans = jnp.clip(mean[None] + noise, -1.0, 1.0).at[0].set(mean)
        values = _finite(objective(key_value, plans))
        # The first plan is the mean: it stays where none can be told from another.
        values = values.at[0].set(jnp.where(jnp.isfinite(values).any(), values[0], 0.0))
        weights = jax.nn.softmax(values / config.temperature)
        return jnp.einsum("p,pha->ha", weights, plans, precision=precision.PRODUCTS), None

    mean, _ = jax.lax.scan(iterate, jnp.clip(start, -1.0, 1.0), jax.random.split(key, config.iterations))
    return Plan(mean, _finite(objective(jax.random.fold_in(key, config.iterations), mean[None]))[0])


def gradient(objective: Objective, key: Array, start: Array, config: PlannerConfig = PlannerConfig()) -> Plan:
    """Gradient ascent on the return through the world model, projected to [-1, 1]; returns the best plan seen.

    It ascends from several plans at once: a return has flat parts and steps (a collision, a lost route), at whose far
    side one slope does not arrive.
    """
    start = jnp.clip(_checked(start), -1.0, 1.0)
    horizon, channels = start.shape
    optimizer = optax.adam(config.learning_rate)
    key_starts, key = jax.random.split(key)
    noise = coloured_noise(key_starts, (config.starts, horizon, channels), config.noise_exponent)
    plans = jnp.clip(start[None] + config.std * noise, -1.0, 1.0).at[0].set(start)

    def total(plans, key):
        values = objective(key, plans)
        return values.sum(), values

    def iterate(carry, key):
        plans, state, best = carry
        slopes, values = jax.grad(total, has_aux=True)(plans, key)
        updates, state = optimizer.update(-jnp.nan_to_num(slopes), state)
        return (jnp.clip(plans + updates, -1.0, 1.0), state, _better(best, plans, values)), None

    first = (plans, optimizer.init(plans), Plan(start, jnp.float32(-jnp.inf)))
    (plans, _, best), _ = jax.lax.scan(iterate, first, jax.random.split(key, config.iterations))
    return _better(best, plans, objective(jax.random.fold_in(key, config.iterations), plans))


def _better(best: Plan, plans: Array, values: Array) -> Plan:
    """The best of these plans [N, H, 2] and of the best before."""
    values = _finite(values)
    index = values.argmax()
    return jax.tree.map(lambda new, old: jnp.where(values[index] > best.value, new, old),
                        Plan(plans[index], values[index]), best)


def _checked(start: Array) -> Array:
    """The plan to start from, float32 [H, 2].

    Raises:
      ValueError: for another shape, or where it is concrete and not finite.
    """
    if jnp.ndim(start) != 2 or jnp.shape(start)[1] != environment_lib.ACTION_CHANNELS or not jnp.shape(start)[0]:
        raise ValueError(f"planner: got a start {list(jnp.shape(start))}, expected [H, 2].")
    checks.finite("planner", start=start)
    return jnp.asarray(start, jnp.float32)


PLANNERS = {"cem": cem, "mppi": mppi, "gradient": gradient}


def imagined_returns(environment: environment_lib.Environment, params: environment_lib.EnvParams,
                     state: environment_lib.EnvState, *, discount: float = 0.98, noises: int = 1) -> Objective:
    """The discounted return of plans from one EnvState, averaged over `noises` imagined futures.

    All plans see the same noise, so that they differ by their actions alone. After a predicted collision nothing more
    is earned.
    """
    def returns(key, plans):
        horizon = plans.shape[1]

        def one(key, plan):
            _, transitions = environment_lib.play(environment, params, key, state, plan, horizon)
            return _discounted(transitions.reward, transitions.terminated, discount)

        keys = jax.random.split(key, noises)
        return jax.vmap(lambda plan: jax.vmap(one, (0, None))(keys, plan).mean())(plans)

    return returns


def shared_future_returns(environment: environment_lib.Environment, params: environment_lib.EnvParams,
                          state: environment_lib.EnvState, *, discount: float = 0.98) -> Objective:
    """As imagined_returns, but one future is imagined for all plans: that of the first (CEM's and MPPI's mean).

    Every plan drives through the occupancy that was predicted along it, on the path of the contract's bicycle: the
    others on the road are taken to do the same whatever the car does. Of P plans one is imagined and decoded instead of
    all; for that one the returns are those of imagined_returns.

    Raises:
      ValueError: for a reward or a path that need each plan's own latents (Environment.shares_future).
    """
    if not environment.shares_future:
        raise ValueError(f"shared_future_returns: the reward is a function of its own or the path is that of "
                         f"{environment.ego_path!r}, which need each plan's own future; use imagined_returns.")

    def returns(key, plans):
        count = plans.shape[0]
        start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, 1, *leaf.shape)), state.motion)
        after = motion_ops.path(jax.tree.map(lambda leaf: leaf[:, 0], start), plans, environment.contract,
                                environment.periods)
        before = jax.tree.map(lambda first, path: jnp.concatenate([first, path[:, :-1]], axis=1), start, after)
        touched = None
        if environment.reward_config.collision:
            touched = _touched(environment, params, jax.random.split(key, 1)[0], state, plans[0], before, after)
        unharmed = None if touched is None else rewards.unharmed_before(touched, environment.reward_config,
                                                                        state.unharmed)
        moment = rewards.Moment(before, after, plans, state.latent.features, {}, route=params.route_of(state),
                                unharmed=unharmed)
        reward, terminated, _ = rewards.weighed(moment, touched, contract=environment.contract,
                                                step_s=environment.step_s, config=environment.reward_config)
        reward = environment.caution.believed(reward, state.time + 1 + jnp.arange(plans.shape[1]))
        return jax.vmap(lambda reward, ended: _discounted(reward, ended, discount))(reward, terminated)

    return returns


def _touched(environment, params, key, state, shared, before, after):
    """Collision probabilities [P, H] of the motions [P, H] in what is imagined under the plan `shared`, the first."""
    config, grid, pooled = environment.reward_config, environment.model.config.voxels, environment.pooled
    count, horizon = after.speed_mps.shape

    def under(obstacles, pose, pooled=True):
        poses = jnp.swapaxes(rewards.poses_ahead(pose, before, after, config.ahead_s), 0, 1)  # [H, P, N, 3]
        found = rewards.box_collision(obstacles, poses.reshape(horizon, -1, 3), grid, config.box, pooled=pooled)
        return found.reshape(horizon, count, -1).max(axis=-1).T

    # The others' gradients see the future as it is: it moves with the shared plan, not with theirs.
    occupancy = environment.occupancy_ahead(params, key, state, jax.lax.stop_gradient(shared))
    imagined = rewards.obstacle_plan(occupancy, grid, config.box, pooled=pooled)
    touched = under(imagined, motion_ops.relative(after.pose, jax.lax.stop_gradient(after.pose[:1])), pooled)
    seen = environment.seen_ahead(params, state, state.time + 1 + jnp.arange(horizon))
    return touched if seen is None else jnp.maximum(touched, under(seen, after.pose))


def _discounted(reward: Array, terminated: Array, discount: float) -> Array:
    """The return of rewards [H]; after the step that terminates nothing more is earned."""
    alive = 1.0 - terminated.astype(jnp.float32)
    before = jnp.concatenate([jnp.ones(1, jnp.float32), jnp.cumprod(alive)[:-1]])
    return (discount ** jnp.arange(reward.shape[0], dtype=jnp.float32) * before * reward).sum()


def shift(plan: Array) -> Array:
    """The plan [H, 2] one step later; its last action is repeated."""
    return jnp.concatenate([plan[1:], plan[-1:]])


def coloured_noise(key: Array, shape: tuple[int, int, int], exponent: float) -> Array:
    """Unit-variance noise [P, H, A] whose power falls with frequency over H as 1 / f**exponent; 0 gives white noise."""
    white = jax.random.normal(key, shape, jnp.float32)
    if not exponent or shape[1] < 2:
        return white
    frequencies = jnp.fft.rfftfreq(shape[1]).astype(jnp.float32)
    scale = jnp.maximum(frequencies, frequencies[1]) ** (-exponent / 2)
    coloured = jnp.fft.irfft(jnp.fft.rfft(white, axis=1) * scale[None, :, None], n=shape[1], axis=1)
    weights = jnp.where((jnp.arange(scale.shape[0]) == 0) | (2 * jnp.arange(scale.shape[0]) == shape[1]),
                        jnp.float32(1.0), jnp.float32(2.0))
    return coloured / jnp.sqrt((weights * scale**2).sum() / shape[1])


def _finite(values: Array) -> Array:
    return jnp.where(jnp.isfinite(values), values, -jnp.inf)
