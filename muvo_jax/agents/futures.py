"""Futures imagined once and driven many times: what makes learning to drive a matter of minutes.

A step of imagination of the default run costs some 3 ms of processor time, nearly all of it the transition's. Here a
policy drives in imagination (`imagine`), and what is decoded along the way is kept; then the policy drives the same
futures again and again (`drive`) on the bicycle's path, through the obstacles that were decoded, and each such step is
some hundred reads of a map. It assumes what planners.shared_future_returns assumes: that others do the same whatever
the car does. The first drive, with the policy that imagined, is that of the environment itself.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import episodes, rewards, road
from muvo_jax.agents import route as route_lib
from muvo_jax.agents.episodes import EnvState, Plans, Transition
from muvo_jax.model import checks, glimpse
from muvo_jax.model import memory as memory_lib
from muvo_jax.ops import motion as motion_ops
from muvo_jax.types import Array, Motion

SCATTERED_SHARE = 0.7  # of the starts that `scattered` moves
_NO_LATENT: Any = None  # of a car that drives in a future imagined before
_SCATTER = (0.0, 0.4, 0.08, 1.0)  # standard deviations: m forward, m left, rad, m/s


@flax.struct.dataclass
class Futures:
    """N imagined futures of H steps.

    Attributes:
      obstacles: float32 [N, H + 1, X, Y], rewards.obstacle_plan of each moment, the start's first.
      pose: float32 [N, H + 1, 3], where the car that imagined stood, in the frame of the start.
      seen: Plans [N, ...], as EnvParams.seen, or None.
      routes: Route [N, ...], or None.
      speed_mps: float32 [N], at the start.
      reward, progress_m: float32 [N, H], what the drive that imagined earned; terminated, bool [N, H].
      feared: float32 [N, H, X, Y], the obstacles after each step as the reward read them, where they were sought in
        several branches (Environment.caution); None where they are those above.
    """

    obstacles: Array
    pose: Array
    seen: Plans | None
    routes: route_lib.Route | None
    speed_mps: Array
    reward: Array
    progress_m: Array
    terminated: Array
    feared: Array | None = None

    @property
    def count(self) -> int:
        return self.speed_mps.shape[0]

    @property
    def horizon(self) -> int:
        return self.pose.shape[1] - 1

    def __getitem__(self, index: Any) -> Futures:
        return jax.tree.map(lambda leaf: leaf[index], self)


def check(environment: environment_lib.Environment) -> None:
    """Raises ValueError for an environment whose futures cannot be shared, or that does not observe the road."""
    if environment.observation != "road" or not environment.shares_future:
        raise ValueError(f"futures: got the observation {environment.observation!r} and the path of "
                         f"{environment.ego_path!r}; expected Environment(observation=\"road\") with the driving "
                         f"reward and a contract with kinematics='bicycle'. Other agents learn by "
                         f"actor_critic.update.")


def imagine(environment: environment_lib.Environment, params: environment_lib.EnvParams, key: Array, starts: Array,
            policy: jax.tree_util.Partial, horizon: int) -> Futures:
    """Drives `horizon` steps from each start under a policy(key, observation) -> action, and keeps what it decodes.

    Args:
      environment: with observation "road"; see `check`.
      params: of starts that are the newest observation of their window (Environment.starts with skip = T - 1).
      key: typed key.
      starts: int32 [N], indices into the bank.
      policy: as environment.play takes it.
      horizon: steps, H.

    Raises:
      ValueError: for another environment, starts that the bank does not have or from which evidence cannot be worked
        out once, or a policy that chose what is no number, naming the step.
    """
    check(environment)
    checks.counts(horizon, None, "futures.imagine")
    memory_lib.check_indices("futures.imagine", "starts", starts, params.bank.size, "starts of the bank")
    vantage = params.bank.latent.vantage
    if params.bank.memory is not None and vantage is not None:
        newest = params.bank.memory.pose.shape[1] - 1
        if (np.asarray(vantage.last) != newest).any():
            raise ValueError(f"futures.imagine: some starts are observations {np.unique(vantage.last).tolist()} of "
                             f"windows of {newest + 1}; expected the newest of each, Environment.starts(observed, "
                             f"batch, skip={newest}).")
    found, actions = _imagine(environment, params, key, jnp.asarray(starts, jnp.int32),
                              environment_lib.as_partial(policy), horizon)
    checks.chosen_actions(jnp.swapaxes(actions, 0, 1), "futures.imagine")
    return found


@functools.partial(jax.jit, static_argnames=("environment", "horizon"))
def _imagine(environment, params, key, starts, policy, horizon):
    params = _of_starts(params, starts)
    model, bank, count = environment.model, params.bank, starts.shape[0]
    cautious = environment.caution.branches > 1
    state = jax.vmap(environment.state_at, (0, None))(jnp.arange(count), params)
    obstacles = jax.vmap(environment.obstacles, (0, None))(state, params)
    if bank.memory is not None and memory_lib.guessed_heads(model.config):
        # Worked out once for all steps: a tenth of the work. It holds for imagined states alone, not for the start.
        informed = glimpse.with_evidence(model.config, bank.memory, bank.latent.vantage)
        params = dataclasses.replace(params, bank=dataclasses.replace(bank, memory=informed))

    def step(carry, key):
        state, obstacles = carry
        key_policy, key_step = jax.random.split(key)
        observation = jax.vmap(environment.road, (0, None, 0))(state, params, obstacles)
        action = jax.vmap(policy)(jax.random.split(key_policy, count), observation)
        state, transition, read = jax.vmap(environment.advance, (0, 0, 0, None))(jax.random.split(key_step, count),
                                                                                 state, action, params)
        obstacles = feared = jax.vmap(environment.obstacle_plan)(read["occupancy"])
        if cautious:
            obstacles = jax.vmap(environment.obstacles, (0, None))(state, params)
        kept = (obstacles, state.motion.pose, transition.reward, transition.terms["progress_m"], transition.terminated,
                feared if cautious else None)
        return (state, obstacles), (kept, action)

    _, (after, actions) = jax.lax.scan(step, (state, obstacles), jax.random.split(key, horizon))
    plans, poses, reward, progress_m, terminated, feared = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), after)
    first = lambda start, rest: jnp.concatenate([start[:, None], rest], axis=1)
    return Futures(first(obstacles, plans), first(state.motion.pose, poses), params.seen, params.routes,
                   bank.speed_mps, reward, progress_m, terminated, feared), actions


def _of_starts(params, starts):
    """The params of a bank that holds these starts alone, each with a memory of its own."""
    pick = lambda leaf: leaf[starts]
    bank, rows = params.bank, jnp.arange(starts.shape[0])
    memory = bank.memory
    if memory is not None:
        memory = jax.tree.map(lambda leaf: leaf[bank.row[starts]], memory)
    chosen = dataclasses.replace(bank, latent=bank.latent[starts], speed_mps=pick(bank.speed_mps), memory=memory,
                                 route_map=None if bank.route_map is None else pick(bank.route_map),
                                 row=None if bank.row is None else rows)
    return dataclasses.replace(params, bank=chosen, routes=jax.tree.map(pick, params.routes),
                               seen=jax.tree.map(pick, params.seen))


def scattered(key: Array, speed_mps: Array) -> Motion:
    """Motion [N] to start from, at recorded speeds [N]: most of them moved in their lane, turned and at another speed.

    A recording knows a car that is where it should be; an agent must also come back.
    """
    key_moved, key_which = jax.random.split(key)
    count = speed_mps.shape[0]
    moved = jnp.asarray([_SCATTER], jnp.float32) * jax.random.normal(key_moved, (count, 4), jnp.float32)
    moved = jnp.where(jax.random.uniform(key_which, (count, 1)) < SCATTERED_SHARE, moved, 0.0)
    return Motion(moved[:, :3], jnp.maximum(speed_mps + moved[:, 3], 0.0))


@flax.struct.dataclass
class Around:
    """What is around a car in its future after some steps, leading axes any: see Futures.

    Attributes:
      obstacles: Plans, and `before` those of road.BEFORE_S earlier, or None without memory.
      feared: float32 [..., X, Y], in the frame of `obstacles`.
      seen: float32 [..., X, Y], in the frame of the start, or None; `seen_before` what of it counts beside `before`.
    """

    obstacles: Plans
    feared: Array
    seen: Array | None
    before: Plans | None
    seen_before: Array | None
    route: route_lib.Route | None


def around(environment: environment_lib.Environment, futures: Futures, index: Any, step: Array) -> Around:
    """What is around the cars in the futures `index`, an integer or a slice, `step` steps after their start."""
    decoded = Plans(futures.obstacles, futures.pose)
    feared = futures.obstacles[index, step] if futures.feared is None else futures.feared[
        index, jnp.maximum(step - 1, 0)]
    seen = before = seen_before = None
    if futures.seen is not None:
        seen = jnp.where(environment.holds_seen(step), futures.seen.plan[index, -1], 0.0)
        if back := environment.steps_before:
            seen_before = jnp.where(step > back, seen, 0.0)
            later = decoded[index, jnp.maximum(step - back, 0)]
            later = Plans(rewards.full_size(later.plan, environment.model.config.voxels), later.pose)
            before = jax.tree.map(lambda scanned, later: jnp.where(step <= back, scanned, later),
                                  futures.seen[index, jnp.minimum(step, back)], later)
    return Around(decoded[index, step], feared, seen, before, seen_before,
                  jax.tree.map(lambda leaf: leaf[index], futures.routes))


def look(environment: environment_lib.Environment, here: Around, motion: Motion) -> Array:
    """The observation [CHANNELS] of one car."""
    return road.observe(motion, here.route, here.obstacles, here.seen, here.before, here.seen_before,
                        grid=environment.model.config.voxels, config=environment.reward_config,
                        pooled=environment.pooled)


def advance(environment: environment_lib.Environment, there: Around, motion: Motion, action: Array, step: Array,
            unharmed: Array | float | None = None) -> tuple[Motion, Array, Array, dict[str, Array]]:
    """One car drives one step on the bicycle's path, its step-th: Motion, reward, terminated and the reward's terms.

    there: around it after the step.
    unharmed: as EnvState's, before it; None counts as 1.
    """
    config, grid, touched = environment.reward_config, environment.model.config.voxels, None
    after = motion_ops.drive(motion, action, environment.contract, environment.periods)
    if config.collision:
        places = rewards.poses_ahead(after.pose, motion, after, config.ahead_s)
        touched = rewards.box_collision(there.feared, motion_ops.relative(places, there.obstacles.pose[None]), grid,
                                        config.box, pooled=environment.pooled)
        if there.seen is not None:
            touched = jnp.maximum(touched, rewards.box_collision(there.seen, places, grid, config.box))
        touched = touched.max()
    moment = rewards.Moment(motion, after, action, motion.speed_mps, {}, route=there.route, unharmed=unharmed)
    reward, terminated, terms = rewards.weighed(moment, touched, contract=environment.contract,
                                                step_s=environment.step_s, config=config)
    return after, environment.caution.believed(reward, step), terminated, terms


# (observation [N, CHANNELS], step) -> (actions [N, 2] in [-1, 1], anything)
Act = Callable[[Array, Array], tuple[Array, Any]]


def drive(environment: environment_lib.Environment, futures: Futures, start: Motion, act: Act):
    """Drives futures on the bicycle's path, through the obstacles that were decoded in them.

    Differentiable in what `act` returns: where the car goes, its rewards and observations follow from the actions; the
    future itself does not. Started where the future starts and acting as the policy that imagined it, it earns what
    that policy earned.

    Returns:
      observations [H + 1, N, CHANNELS], rewards [H, N], terminated bool [H, N], and what `act` returned beside the
      actions, [H, N, ...].
    """
    observed, reward, terminated, _, extra = _drive(environment, futures, start, act, weighed=True)
    return observed, reward, terminated, extra


def drive_unharmed(environment: environment_lib.Environment, futures: Futures, start: Motion, act: Act):
    """As `drive`, but each step earns what it is worth to a car that came to it unharmed, and instead of `terminated`
    stands how likely the step ends the drive, float32 [H, N]."""
    observed, reward, terminated, unharmed, extra = _drive(environment, futures, start, act, weighed=False)
    return observed, reward, jnp.where(terminated, 1.0, 1.0 - unharmed), extra


def _drive(environment, futures, start, act, weighed):
    """As `drive`; after `terminated` EnvState's `unharmed` after each step, of a car that is unharmed before each step
    unless steps are `weighed` by those before them."""
    surroundings = lambda step: around(environment, futures, slice(None), step)
    observe = lambda motion, step: jax.vmap(functools.partial(look, environment))(surroundings(step), motion)

    def step(carry, index):
        motion, left = carry
        observation = observe(motion, index)
        action, extra = act(observation, index)
        after, reward, terminated, terms = jax.vmap(functools.partial(advance, environment), (0, 0, 0, None, 0))(
            surroundings(index + 1), motion, action, index + 1, left)
        unharmed = terms.get("unharmed", left)
        return (after, unharmed if weighed else left), (observation, reward, terminated, unharmed, extra)

    (last, _), (observed, *driven) = jax.lax.scan(step, (start, jnp.ones_like(start.speed_mps)),
                                                  jnp.arange(futures.horizon))
    return jnp.concatenate([observed, observe(last, futures.horizon)[None]]), *driven


@flax.struct.dataclass
class FuturesParams:
    """What SharedFutures runs on: the futures, and as many steps as they have, int32."""

    futures: Futures
    max_steps_in_episode: Array


@dataclasses.dataclass(frozen=True)
class SharedFutures:
    """Imagined futures as an environment for the doors to other libraries, with the functions of Environment: a step is
    one of `drive`'s, and starts are scattered.

    Attributes:
      environment: in which they were imagined.
    """

    environment: environment_lib.Environment

    def __post_init__(self):
        check(self.environment)

    def params(self, futures: Futures) -> FuturesParams:
        """Packs what the environment runs on."""
        return FuturesParams(futures, jnp.int32(futures.horizon))

    @property
    def observation_shapes(self) -> jax.ShapeDtypeStruct:
        return self.environment.observation_shapes

    @property
    def step_s(self) -> float:
        return self.environment.step_s

    def reset(self, key: Array, params: FuturesParams) -> tuple[Array, EnvState]:
        """Draws a future: (observation, state); the state has no latent."""
        key_which, key_start = jax.random.split(key)
        start = jax.random.randint(key_which, (), 0, params.futures.count, jnp.int32)
        motion = jax.tree.map(lambda leaf: leaf[0], scattered(key_start, params.futures.speed_mps[start][None]))
        state = EnvState(_NO_LATENT, motion, start, jnp.int32(0), jnp.float32(0), jnp.bool_(False), jnp.float32(1))
        return self.observe(state, params), state

    def observe(self, state: EnvState, params: FuturesParams) -> Array:
        """The observation "road" of a state."""
        return look(self.environment, around(self.environment, params.futures, state.start, state.time), state.motion)

    def step(self, key: Array, state: EnvState, action: Array, params: FuturesParams) -> tuple[EnvState, Transition]:
        """One step under action [2], clipped to [-1, 1]; it draws nothing."""
        del key
        action = jnp.clip(checks.one_action(action, (), "SharedFutures.step", clips=True), -1.0, 1.0)
        there = around(self.environment, params.futures, state.start, state.time + 1)
        motion, reward, terminated, terms = advance(self.environment, there, state.motion, action, state.time + 1,
                                                    state.unharmed)
        after = EnvState(_NO_LATENT, motion, state.start, state.time + 1, reward, terminated,
                         terms.get("unharmed", state.unharmed))
        return after, Transition(look(self.environment, there, motion), reward, terminated,
                                 after.time >= params.max_steps_in_episode, terms)

    def restart(self, key: Array, state: EnvState, observation: Array, final: Array,
                params: FuturesParams) -> tuple[EnvState, Array]:
        """As Environment.restart."""
        return episodes.restart(self, key, state, observation, final, params)
