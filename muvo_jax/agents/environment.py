"""Imagination as an environment: the one core behind all doors. Pure functions over pytrees, no library of others.

An episode starts in a latent state of a bank that was filled from a recording, and goes on in imagination. At its
horizon it is truncated: the world does not end there, so bootstrap from the final observation. It terminates only where
the reward function says so (by default: at a predicted collision).
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp

from muvo_jax import config as config_lib
from muvo_jax import limits
from muvo_jax import run as run_lib
from muvo_jax.agents import episodes, fits, forks, rewards, road, uncertainty
from muvo_jax.agents.episodes import EnvParams, EnvState, StartBank, Transition
from muvo_jax.model import checks
from muvo_jax.model import memory as memory_lib
from muvo_jax.model.world_model import WorldModel
from muvo_jax.ops import motion as motion_ops
from muvo_jax.types import Array, LatentState, Variables

ACTION_CHANNELS = checks.ACTION_CHANNELS
RewardFunction = Callable[[rewards.Moment], tuple[Array, Array, dict[str, Array]]]


@dataclasses.dataclass(frozen=True)
class Environment:
    """Hashable description of the environment; one car, no batch axis: use jax.vmap.

    Attributes:
      model: the world model.
      contract: what actions mean.
      periods: recorded periods in a model step (config.data.stride).
      reward_config: of the driving reward.
      reward_function: instead of it, (Moment) -> (reward, terminated, terms); `reward_heads` are decoded for it.
      reward_heads: heads that the reward reads.
      observation: "features" (model.policy_features) or "road" (agents/road.py), one vector each, or names of heads,
        decoded at full size.
      trained_steps: as many as training imagined, where that is known; `params` warns of longer episodes.
      caution: what late rewards count, and how many branches of each step are searched for obstacles.
    """

    model: WorldModel
    contract: config_lib.ActionContract = config_lib.ActionContract()
    periods: Annotated[int, limits.COUNT] = 1
    reward_config: rewards.RewardConfig = rewards.RewardConfig()
    reward_function: RewardFunction | None = None
    reward_heads: tuple[str, ...] | None = None
    observation: Literal["features", "road"] | tuple[str, ...] = "features"
    trained_steps: int | None = None
    caution: uncertainty.Caution = uncertainty.Caution()

    def __post_init__(self):
        limits.check(self)
        if not isinstance(self.observation, str):
            object.__setattr__(self, "observation", tuple(self.observation))  # a list has no hash
        fits.settings(self)

    @classmethod
    def of_run(cls, run: run_lib.Run, *, learned_reward: bool = False, **options: Any) -> Environment:
        """The environment of a run: model, contract and stride are its own; options as in Environment.

        `learned_reward` takes reward and ends from the heads reward and continue (rewards.learned_reward). The driving
        reward reads the route map at the recording's scale where reward_config does not say another one.
        """
        reward_config = options.get("reward_config", rewards.RewardConfig())
        if reward_config.route == config_lib.RouteMap():
            options["reward_config"] = dataclasses.replace(reward_config, route=run.config.data.route_map)
        if learned_reward:
            options |= {"reward_function": rewards.learned_reward, "reward_heads": rewards.LEARNED_HEADS}
        options.setdefault("trained_steps", run.config.imagined_steps)
        return cls(run.model, contract=run.contract, periods=run.config.data.stride, **options)

    @property
    def ego_path(self) -> Literal["bicycle", "ego_motion"] | None:
        """Where the imagined path comes from: the contract's kinematics, else the head, else there is none."""
        if self.contract.kinematics == "bicycle":
            return "bicycle"
        return "ego_motion" if "ego_motion" in self.model.config.heads else None

    @property
    def shares_future(self) -> bool:
        """Whether a plan can be judged in the future of another one: path and reward need no latents of its own."""
        return self.reward_function is None and self.ego_path == "bicycle"

    @property
    def pooled(self) -> bool:
        """Whether coarse occupancy was trained on pooled labels; see rewards.centres_m."""
        return self.model.config.numerics == "standard"

    @property
    def step_s(self) -> float:
        """Seconds of one step."""
        return self.periods / self.contract.rate_hz

    @property
    def steps_before(self) -> int:
        """How many steps the observation looks back: road.BEFORE_S of them, if the model remembers so much; 0 for any
        but "road"."""
        guess = self.model.config.first_guess
        if self.observation != "road" or not isinstance(guess, config_lib.LastSeen):
            return 0
        return min(max(1, round(road.BEFORE_S / self.step_s)), guess.memory_frames - 1)

    @property
    def decoded_heads(self) -> tuple[str, ...]:
        """What every step decodes."""
        path = ("ego_motion",) if self.ego_path == "ego_motion" else ()
        return tuple(dict.fromkeys((*self._observed_heads, *self.rewarded_heads, *path)))

    @property
    def _observed_heads(self) -> tuple[str, ...]:
        if self.observation == "features":
            return ()
        return ("occupancy",) if self.observation == "road" else tuple(self.observation)

    @property
    def tests_collisions(self) -> bool:
        """Whether the driving reward looks for collisions."""
        return self.reward_function is None and self.reward_config.collision > 0

    @property
    def reads_obstacles(self) -> bool:
        """Whether reward or observation look for what stands at the height of the car."""
        return self.tests_collisions or self.observation == "road"

    @property
    def rewarded_heads(self) -> tuple[str, ...]:
        """Heads that the reward reads, `reward_heads` or those of the driving reward."""
        if self.reward_heads is not None:
            return self.reward_heads
        return ("occupancy",) if self.tests_collisions else ()

    @property
    def observation_shapes(self) -> Any:
        """jax.ShapeDtypeStruct of an observation: one, or a dict of them by head."""
        if self.observation == "road":
            return jax.ShapeDtypeStruct((road.CHANNELS,), jnp.float32)
        config = self.model.config

        def example(variables):
            latent = self.model.initial_state(1)
            bank = StartBank(latent, jnp.zeros((1,)), None, memory_lib.empty(config, 1), jnp.zeros((1,), jnp.int32))
            return self._shown(latent.features[0], self._decode(variables, bank, latent[0], jnp.int32(0))[0])

        return jax.eval_shape(example, self.model.variable_shapes())

    starts = staticmethod(episodes.starts)

    def params(self, variables: Variables, bank: StartBank, horizon: int, temperature: float = 1.0) -> EnvParams:
        """Checks and packs what the environment runs on. Warns of a horizon longer than training imagined.

        Cars side by side may have horizons of their own: replace max_steps_in_episode by int32 [N], and map it.

        Raises:
          ValueError: for a bank of another model or recording, an empty one, or a horizon below 1.
        """
        fits.starts(self, bank)
        checks.counts(horizon, None, "params")
        checks.scalar("params", temperature=temperature)
        checks.finite("params", temperature=temperature)
        if self.trained_steps is not None and horizon > self.trained_steps and not isinstance(
                bank.speed_mps, jax.core.Tracer):
            warnings.warn(f"Environment.params: an episode of {horizon} steps is longer than the {self.trained_steps} "
                          f"that training imagined. How far this model can be trusted, python -m muvo_jax.evaluate "
                          f"RUN --uncertainty=8 measures.", stacklevel=2)
        seen = None
        if self.reads_obstacles:
            seen = episodes.seen(bank, self.model.config.voxels, self.reward_config.box, self.steps_before)
        return EnvParams(jax.tree.map(jnp.asarray, variables), bank, jnp.int32(horizon), jnp.float32(temperature),
                         episodes.routes(bank, self.reward_config.route), seen)

    def reset(self, key: Array, params: EnvParams) -> tuple[Any, EnvState]:
        """Draws a start from the bank: (observation, state)."""
        forks.check("Environment.reset")
        start = jax.random.randint(key, (), 0, params.bank.size, jnp.int32)
        state = self.state_at(start, params)
        return self.observe(state, params), state

    def state_at(self, start: Array, params: EnvParams) -> EnvState:
        """The first moment of an episode from `start`, int32 index into the bank."""
        bank = params.bank
        return EnvState(bank.latent[start], motion_ops.at_rest_of_frame(bank.speed_mps[start]), start, jnp.int32(0),
                        jnp.float32(0), jnp.bool_(False), jnp.float32(1),
                        params.seen[start] if self.steps_before and params.seen is not None else None)

    def observe(self, state: EnvState, params: EnvParams) -> Any:
        """The observation of a state."""
        decoded, coarse = self._decode(params.variables, params.bank, state.latent, state.start, self._observed_heads)
        return self._observe(state, params, decoded, coarse)

    def decoded(self, state: EnvState, params: EnvParams, heads: tuple[str, ...]) -> dict[str, Array]:
        """Full-size predictions of a state, by head."""
        return self._decode(params.variables, params.bank, state.latent, state.start, heads)[0]

    def obstacles(self, state: EnvState, params: EnvParams) -> Array:
        """Probabilities [X, Y] that something stands in a column of voxels, as decoded of a state, in the car's own
        frame (rewards.obstacle_plan)."""
        _, coarse = self._decode(params.variables, params.bank, state.latent, state.start, ("occupancy",))
        return self.obstacle_plan(coarse["occupancy"])

    def road(self, state: EnvState, params: EnvParams, obstacles: Array) -> Array:
        """The observation "road" [road.CHANNELS] of a state with these `obstacles`."""
        seen, before, seen_before = self.seen_ahead(params, state, state.time), None, None
        if state.past is not None and seen is not None:
            before, seen_before = state.past[0], jnp.where(state.time > self.steps_before, seen, 0.0)
        plans = episodes.Plans(obstacles, state.motion.pose)
        return road.observe(state.motion, params.route_of(state), plans, seen, before, seen_before,
                            grid=self.model.config.voxels, config=self.reward_config, pooled=self.pooled)

    def step(self, key: Array, state: EnvState, action: Array, params: EnvParams) -> tuple[EnvState, Transition]:
        """One imagined step under action [2], clipped to [-1, 1]; see Transition. No auto-reset: `restart` does it."""
        return self.advance(key, state, action, params)[:2]

    def advance(self, key: Array, state: EnvState, action: Array,
                params: EnvParams) -> tuple[EnvState, Transition, dict[str, Array]]:
        """As `step`; beside it what the reward read, by head, the occupancy as `caution` has it."""
        forks.check("Environment.step")
        action = self._checked(action)
        checks.finite_on_host("Environment.step", state=state)
        checks.forward_mode("Environment.step", self.model, params.variables, state, action)
        latents = self._branches(key, state.latent, action, params)
        latent = latents[0]
        full, coarse = self._decode(params.variables, params.bank, latent, state.start)
        read = coarse if self.caution.branches == 1 else coarse | {
            "occupancy": self.caution.feared(self._occupancy(params, latents, state.start))}
        motion = state.motion
        if self.ego_path == "bicycle":
            motion = motion_ops.drive(motion, action, self.contract, self.periods)
        elif self.ego_path == "ego_motion":
            motion = motion_ops.moved(motion, full["ego_motion"])
        route_map = None if params.bank.route_map is None else params.bank.route_map[state.start]
        moment = rewards.Moment(state.motion, motion, action, latent.features, read, route_map,
                                params.route_of(state), self.seen_ahead(params, state, after_steps=state.time + 1),
                                state.unharmed)
        reward, terminated, terms = self._reward(moment)
        reward = self.caution.believed(reward, state.time + 1)
        past = state.past
        if past is not None:
            past = past.then(rewards.full_size(self.obstacle_plan(coarse["occupancy"]), self.model.config.voxels),
                             motion.pose)
        after = EnvState(latent, motion, state.start, state.time + 1, reward, terminated,
                         jnp.asarray(terms.get("unharmed", state.unharmed), jnp.float32), past)
        truncated = after.time >= params.max_steps_in_episode
        return after, Transition(self._observe(after, params, full, coarse), reward, terminated, truncated, terms), read

    def restart(self, key: Array, state: EnvState, observation: Any, final: Array,
                params: EnvParams) -> tuple[EnvState, Any]:
        """Where `final`, a fresh start takes the place of state and observation."""
        return episodes.restart(self, key, state, observation, final, params)

    def occupancy_ahead(self, params: EnvParams, key: Array, state: EnvState, plan: Array) -> Array:
        """Occupancy logits [H, X, Y, Z, 2] at the reward's scale after each step of a plan [H, 2], in the frame of the
        car of that moment, as the reward reads them. The noise is that of `play` under the same key."""
        keys = jax.vmap(lambda key: jax.random.split(key)[1])(jax.random.split(key, plan.shape[0]))

        def step(latent, inputs):
            key, action = inputs
            latents = self._branches(key, latent, self._checked(action), params)
            return latents[0], latents

        _, latents = jax.lax.scan(step, state.latent, (keys, plan))
        lead = (plan.shape[0], self.caution.branches)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), latents)
        logits = self._occupancy(params, flat, state.start)
        return self.caution.feared(jnp.moveaxis(logits.reshape(*lead, *logits.shape[1:]), 1, 0))

    def seen_ahead(self, params: EnvParams, state: EnvState, after_steps: Array) -> Array | None:
        """What was seen at the start and counts `after_steps` [*L] steps later: [*L, X, Y]; None without memory."""
        if params.seen is None:
            return None
        return jnp.where(jnp.expand_dims(self.holds_seen(after_steps), (-2, -1)), jnp.broadcast_to(
            params.seen.plan[state.start, -1], (*jnp.shape(after_steps), *params.seen.plan.shape[2:])), 0.0)

    def holds_seen(self, after_steps: Array) -> Array:
        """Whether what was seen at the start counts so many steps later, bool."""
        return after_steps * self.step_s <= self.reward_config.seen_s + 1e-6

    def _reward(self, moment: rewards.Moment) -> tuple[Array, Array, dict[str, Array]]:
        if self.reward_function is not None:
            reward, ended, terms = self.reward_function(moment)
            return jnp.asarray(reward, jnp.float32), jnp.asarray(ended, jnp.bool_), terms
        return rewards.driving_reward(moment, grid=self.model.config.voxels, contract=self.contract, step_s=self.step_s,
                                      config=self.reward_config, pooled=self.pooled)

    def _branches(self, key: Array, latent: LatentState, action: Array, params: EnvParams) -> LatentState:
        """Latents [N, ...] of `caution.branches` after one step; the first is the one in which the car goes on. The
        others have full noise at any temperature: how far they differ is what they are drawn for."""
        count, shape = self.caution.branches, latent.stochastic.shape
        noise = jnp.concatenate([params.temperature * jax.random.normal(key, (1, *shape), jnp.float32),
                                 jax.random.normal(jax.random.fold_in(key, 1), (count - 1, *shape), jnp.float32)])
        state = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), (latent, action))
        return self.model.imagine_step(params.variables, noise, *state)[0]

    def _occupancy(self, params: EnvParams, latents: LatentState, start: Array) -> Array:
        """Occupancy logits [N, X, Y, Z, 2] of latents [N, ...] of one start, at the reward's scale."""
        rows = jnp.broadcast_to(start, latents.stochastic.shape[:1])
        return self._decode(params.variables, params.bank, latents, rows, ("occupancy",))[1]["occupancy"]

    def _decode(self, variables: Variables, bank: StartBank, latent: LatentState, start: Array,
                heads: tuple[str, ...] | None = None):
        """(full-size predictions, predictions for the reward) of the heads; unused ones are dropped by the compiler."""
        names = self.decoded_heads if heads is None else heads
        if not names:
            return {}, {}
        row = None if bank.row is None else bank.row[start]
        predictions = self.model.decode(variables, latent, names, bank.memory, row)
        full = {name: predictions[name] for name in names}
        return full, full if "occupancy" not in names else {
            **full, "occupancy": predictions.at_scale(self.reward_config.occupancy_scale).occupancy}

    def obstacle_plan(self, occupancy: Array) -> Array:
        """rewards.obstacle_plan [X, Y] of occupancy logits at the reward's scale."""
        return rewards.obstacle_plan(occupancy, self.model.config.voxels, self.reward_config.box, pooled=self.pooled)

    def _observe(self, state: EnvState, params: EnvParams, decoded: dict[str, Array], coarse: dict[str, Array]) -> Any:
        if self.observation == "road":
            return self.road(state, params, self.obstacle_plan(coarse["occupancy"]))
        return self._shown(state.latent.features, decoded)

    def _shown(self, features: Array, decoded: dict[str, Array]) -> Any:
        if self.observation == "features":
            return self.model.policy_features(features)
        return {name: decoded[name] for name in self.observation}

    def _checked(self, action: Array) -> Array:
        return jnp.clip(checks.one_action(action, (), "Environment.step", clips=True), -1.0, 1.0)


def play(environment: Environment, params: EnvParams, key: Array, state: EnvState, driver: Any,
         horizon: int) -> tuple[EnvState, Transition]:
    """Rolls one episode on: driver is actions [H, 2] or a policy(key, observation) -> action, one with parameters as
    jax.tree_util.Partial(function, parameters), so that new ones compile nothing anew.

    Returns the states and Transitions [H, ...]; nothing restarts.

    Raises:
      ValueError: for concrete actions that are not finite, outside [-1, 1] or of another shape, a state that is not
        finite, or a policy that chose what is no number, naming the step.
      TypeError: for forward-mode derivatives through convolutions that have none (ModelConfig.convolution).
    """
    forks.check("play")
    checks.counts(horizon, None, "play")
    driver = as_partial(driver)
    if not callable(driver):
        if jnp.shape(driver) != (horizon, ACTION_CHANNELS):
            raise ValueError(f"play: got actions {list(jnp.shape(driver))}, expected [{horizon}, 2].")
        checks.action_values(driver, "play")
    checks.finite("play", state=state)
    checks.forward_mode("play", environment.model, params.variables, state, driver)
    played, actions = _play(environment, params, key, state, driver, horizon)
    if callable(driver):
        checks.chosen_actions(actions, "play")
    return played


def as_partial(driver: Any) -> Any:
    """A plain function as what jax.jit takes for an argument; anything else as it is."""
    plain = callable(driver) and not isinstance(driver, jax.tree_util.Partial)
    return jax.tree_util.Partial(driver) if plain else driver


@functools.partial(jax.jit, static_argnames=("environment", "horizon"))
def _play(environment, params, key, state, driver, horizon):
    def step(state, inputs):
        key, action = inputs
        key_policy, key_step = jax.random.split(key)
        if action is None:
            action = driver(key_policy, environment.observe(state, params))
        state, transition = environment.step(key_step, state, action, params)
        return state, ((state, transition), action)

    actions = None if callable(driver) else driver
    return jax.lax.scan(step, state, (jax.random.split(key, horizon), actions))[1]

