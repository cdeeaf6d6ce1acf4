"""Driving a simulator closed loop: observe, filter, plan in imagination, apply the first action, again.

The simulator comes as functions, so that any one will do; a driver is a function of what it remembers and of the
simulator's state. `planning_driver` makes one of a world model, `policy_driver` one of a policy that reads its latents;
the others are what they are measured against.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import planners
from muvo_jax.model import checks, glimpse, live
from muvo_jax.types import Array, ArrayLike, LatentState, Memory, Variables


@dataclasses.dataclass(frozen=True)
class Situation:
    """Where a drive stands.

    Attributes:
      progress_m: metres along the route.
      collided: whether the car touches something.
      lost: whether it left its route.
      arrived: whether the route is at its end.
      speed_mps, heading_rad: of the car, for its passengers' comfort; NaN where the simulator does not say.
    """

    progress_m: float
    collided: bool = False
    lost: bool = False
    arrived: bool = False
    speed_mps: float = float("nan")
    heading_rad: float = float("nan")

    @property
    def over(self) -> bool:
        return self.collided or self.lost or self.arrived


@dataclasses.dataclass(frozen=True)
class Simulator:
    """What the loop needs of a simulator; all functions are pure in its state.

    Attributes:
      reset: seed -> state.
      step: (state, action [2]) -> state, one step of the world model later.
      observe: state -> field of types.Batch -> array without batch and time axis.
      situation: state -> Situation.
      expert: state -> action [2]; drives until a driver takes over, and is a baseline.
      step_s: seconds of one step.
    """

    reset: Callable[[int], Any]
    step: Callable[[Any, np.ndarray], Any]
    observe: Callable[[Any], Mapping[str, ArrayLike]]
    situation: Callable[[Any], Situation]
    expert: Callable[[Any], np.ndarray]
    step_s: float


# (key, memory, state, previous action) -> (memory, action); memory is None at first.
Driver = Callable[[Array, Any, Any, np.ndarray], tuple[Any, np.ndarray]]


@flax.struct.dataclass
class PlanMemory:
    """What the planning driver remembers.

    Attributes:
      live: the filter's state, of a batch of one.
      plan: float32 [H, 2]; its first action was applied.
      value: the return expected of it.
    """

    live: live.LiveState
    plan: Array
    value: Array


@flax.struct.dataclass
class PolicyMemory:
    """What a policy's driver remembers, of a batch of one.

    Attributes:
      live: the filter's state.
      speed_mps, route_map: the newest observation's, [1] and [1, 64, 64] or None; an episode in imagination could start
        here (`standing`).
    """

    live: live.LiveState
    speed_mps: ArrayLike
    route_map: ArrayLike | None


@dataclasses.dataclass(frozen=True)
class Moment:
    """One step of a drive: the state, the action applied in it, and what the driver remembered then."""

    state: Any
    action: np.ndarray
    memory: Any


@dataclasses.dataclass(frozen=True)
class Drive:
    """A drive from the moment at which its driver took over.

    Attributes:
      progress_m: metres along the route until the end, or until the collision or the loss of the route.
      steps: that were driven.
      situations: before the first step and after each.
      moments: its steps; nothing else holds observations.
    """

    progress_m: float
    steps: int
    situations: tuple[Situation, ...]
    moments: tuple[Moment, ...]

    @property
    def end(self) -> Situation:
        """Where it stood at the end."""
        return self.situations[-1]

    @property
    def unharmed(self) -> bool:
        """Whether it ended by time or arrival."""
        return not (self.end.collided or self.end.lost)


def drive(simulator: Simulator, driver: Driver, key: Array, seed: int, steps: int, *, context: int = 0) -> Drive:
    """One drive.

    Args:
      simulator, driver: who drives what.
      key: of the driver; step t uses fold_in(key, t).
      seed: of the simulator.
      steps: to drive at most, from the takeover on.
      context: steps before it, in which the expert drives and the driver watches: it is called, its action is not used.

    Raises:
      ValueError: if steps is below 1 or context negative, the drive is over before the takeover, or the driver chooses
        what is no number, naming the step.
    """
    if steps < 1 or context < 0:
        raise ValueError(f"drive: got steps={steps} and context={context}; expected at least 1 and 0.")
    state, memory, previous = simulator.reset(seed), None, np.zeros(2, np.float32)
    for step in range(context):
        memory, unused = driver(jax.random.fold_in(key, step), memory, state, previous)
        _check_action(unused, seed, step)
        previous = np.asarray(simulator.expert(state), np.float32)
        state = simulator.step(state, previous)
    situations = [simulator.situation(state)]
    if situations[0].over:
        raise ValueError(f"drive: with seed {seed} the expert's drive was over before the takeover: {situations[0]}.")
    moments: list[Moment] = []
    while len(moments) < steps and not situations[-1].over:
        key_step = jax.random.fold_in(key, context + len(moments))
        memory, previous = driver(key_step, memory, state, previous)
        _check_action(previous, seed, context + len(moments))
        moments.append(Moment(state, previous, memory))
        state = simulator.step(state, previous)
        situations.append(simulator.situation(state))
    metres = situations[-1].progress_m - situations[0].progress_m
    return Drive(metres, len(moments), tuple(situations), tuple(moments))


def _check_action(action: np.ndarray, seed: int, step: int) -> None:
    if np.shape(action) != (2,) or not np.abs(action).max() <= 1.0 + 1e-6:  # NaN neither
        raise ValueError(f"drive: with seed {seed}, at step {step} from the first observation on, the driver chose "
                         f"{np.asarray(action).tolist()}; expected two finite numbers in [-1, 1] (acceleration, "
                         f"steering).")


def _check_rate(where: str, simulator: Simulator, environment: environment_lib.Environment) -> None:
    if abs(simulator.step_s - environment.step_s) > 1e-6:
        raise ValueError(f"{where}: the simulator steps {simulator.step_s} s, the model {environment.step_s} s.")


def planning_driver(simulator: Simulator, environment: environment_lib.Environment, variables: Variables,
                    planner: str = "cem", config: planners.PlannerConfig = planners.PlannerConfig(), *,
                    horizon: int = 10, temperature: float = 0.0, discount: float = 0.98,
                    shared_future: bool | None = None) -> Driver:
    """Drives by planning in imagination at every step, from the last plan shifted; compiled once.

    Args:
      simulator: only its `observe` is used; it must give speed_mps and, for progress along the route, route_map.
      environment: model, rewards and contract.
      variables: of the model.
      planner: name in planners.PLANNERS.
      horizon: steps to plan.
      temperature: factor on the latent noise in imagination; 0 plans on the mean future.
      discount: of the planned return.
      shared_future: imagine one future for all plans of an iteration (planners.shared_future_returns) or one for each
        (planners.imagined_returns); None shares it wherever the environment allows.

    Raises:
      ValueError: for an unknown planner, a horizon below 1, or a simulator that steps at another rate than the model.
    """
    if planner not in planners.PLANNERS:
        raise ValueError(f"planner {planner!r} is unknown; known are {', '.join(planners.PLANNERS)}.")
    if shared_future is None:
        shared_future = environment.shares_future
    if horizon < 1:
        raise ValueError(f"planning_driver: horizon is {horizon}; it must be at least 1.")
    _check_rate("planning_driver", simulator, environment)

    def driver(key, memory, state, previous):
        key_filter, key_plan = jax.random.split(key)
        if memory is None:
            memory = PlanMemory(live.start_live(environment.model, key_filter), jnp.zeros((horizon, 2), jnp.float32),
                                jnp.float32(0))
        observation = {name: np.asarray(value)[None] for name, value in simulator.observe(state).items()}
        memory = plan_step(environment, planner, config, variables, key_plan, memory, observation, previous[None],
                           jnp.float32(temperature), discount, shared_future)
        return memory, np.asarray(memory.plan[0])

    return driver


@functools.partial(jax.jit, static_argnames=("environment", "planner", "config", "discount", "shared_future"))
def plan_step(environment: environment_lib.Environment, planner: str, config: planners.PlannerConfig,
              variables: Variables, key: Array, memory: PlanMemory, observation: Mapping[str, Array],
              previous_action: Array, temperature: Array, discount: float, shared_future: bool) -> PlanMemory:
    """Filters one observation (each field [1, ...]) and plans from there on. The latents are means, not samples."""
    filtered = live.observe_step(environment.model, variables, memory.live, observation, previous_action,
                                 sampled=False)
    model_config = environment.model.config
    remembered = glimpse.with_evidence(model_config, filtered.memory, filtered.latent.vantage)  # one for all plans
    params, state = standing(environment, variables, filtered, remembered, observation["speed_mps"],
                             observation.get("route_map"), memory.plan.shape[0])
    params = dataclasses.replace(params, temperature=temperature)
    returns = planners.shared_future_returns if shared_future else planners.imagined_returns
    objective = returns(environment, params, state, discount=discount)
    plan = planners.PLANNERS[planner](objective, key, planners.shift(memory.plan), config)
    return PlanMemory(filtered, plan.actions, plan.value)


# (key, observation [1, ...]) -> actions [1, 2] in [-1, 1].
Policy = Callable[[Array, Any], Array]


def policy_driver(simulator: Simulator, environment: environment_lib.Environment, variables: Variables,
                  policy: Policy, *, sampled: bool = False) -> Driver:
    """Drives by a policy that reads what the model makes of the sensors: filter, observe, act; compiled once.

    Args:
      simulator: only its `observe` is used; it must give all that the model reads, and speed_mps.
      environment: in which the policy learned; its observation is what the policy gets.
      variables: of the model.
      policy: (key, observation [1, ...]) -> actions [1, 2], clipped to [-1, 1]. One with parameters comes as
        jax.tree_util.Partial(function, parameters), as actor_critic.policy makes it, so that new parameters compile
        nothing anew. Whether it draws its actions or takes its mode is its own affair.
      sampled: sample the filter's latents instead of taking their means, which is what planning_driver does.

    Raises:
      ValueError: for a simulator that steps at another rate than the model.
    """
    _check_rate("policy_driver", simulator, environment)
    driver_policy = environment_lib.as_partial(policy)

    def driver(key, memory, state, previous):
        key_filter, key_policy = jax.random.split(key)
        model = environment.model
        stream = live.start_live(model, key_filter) if memory is None else memory.live
        observation = {name: np.asarray(value)[None] for name, value in simulator.observe(state).items()}
        stream = live.observe_step(model, variables, stream, observation, previous[None], sampled=sampled)
        speed_mps, route_map = observation["speed_mps"], observation.get("route_map")
        action = _act(environment, variables, driver_policy, key_policy, stream, speed_mps, route_map)
        return PolicyMemory(stream, speed_mps, route_map), np.asarray(action)

    return driver


@functools.partial(jax.jit, static_argnames=("environment",))
def _act(environment: environment_lib.Environment, variables: Variables, policy: jax.tree_util.Partial, key: Array,
         stream: live.LiveState, speed_mps: Array, route_map: Array | None) -> Array:
    params, state = standing(environment, variables, stream, stream.memory, speed_mps, route_map, 1)
    observation = jax.tree.map(lambda leaf: leaf[None], environment.observe(state, params))
    return checks.policy_action(policy(key, observation), stream.latent.features)[0]


def standing(environment: environment_lib.Environment, variables: Variables, stream: live.LiveState,
             memory: Memory | None, speed_mps: Array, route_map: Array | None,
             horizon: int) -> tuple[environment_lib.EnvParams, environment_lib.EnvState]:
    """An episode that starts where a stream (of a batch of one) stands: its params and first state.

    memory: of the stream, or that with evidence (glimpse.with_evidence).
    """
    bank = environment_lib.StartBank(stream.latent, speed_mps, route_map, memory, jnp.zeros((1,), jnp.int32))
    params = environment.params(variables, bank, horizon)
    return params, environment.state_at(jnp.int32(0), params)


def latents(moments: Sequence[Moment]) -> tuple[LatentState, Memory | None]:
    """The filtered latents [T, ...] of a drive by plans or a policy, and what they remember [T, ...]."""
    stack = lambda *leaves: jnp.concatenate(leaves)
    streams = [moment.memory.live for moment in moments]
    states, memory = (jax.tree.map(stack, *parts) for parts in zip(*((live.latent, live.memory) for live in streams),
                                                                   strict=True))
    return states, memory


def plans(moments: Sequence[Moment]) -> Array:
    """The plans [T, H, 2] of a planned drive."""
    return jnp.stack([moment.memory.plan for moment in moments])


def expert_driver(simulator: Simulator) -> Driver:
    """The simulator's own expert, deciding at the model's rate."""
    return lambda key, memory, state, previous: (memory, np.asarray(simulator.expert(state), np.float32))


def constant_driver(action: Sequence[float]) -> Driver:
    """Always the same action."""
    fixed = np.asarray(action, np.float32)
    return lambda key, memory, state, previous: (memory, fixed)


def random_driver() -> Driver:
    """A uniform action in [-1, 1] at every step."""
    draw = lambda key: np.asarray(jax.random.uniform(key, (2,), jnp.float32, minval=-1.0))
    return lambda key, memory, state, previous: (memory, draw(key))
