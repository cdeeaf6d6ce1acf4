"""A small world model with fresh weights, and environments on it, for the tests of agents."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.agents import environment as environment_lib
from muvo_jax.agents import rewards
from muvo_jax.model import memory as memory_lib
from muvo_jax.model import world_model
from muvo_jax.types import Gaussian, LatentState, Predictions

CONFIG = presets.get("tiny").model
MODEL = world_model.WorldModel(CONFIG)
STARTS, HORIZON = 5, 3
NO_COLLISION = rewards.RewardConfig(collision=0.0)


@functools.cache
def variables():
    return jax.tree.map(jnp.asarray, MODEL.init(jax.random.key(0)))


@functools.cache
def bank():
    draw = lambda seed, channels: jax.random.normal(jax.random.key(seed), (STARTS, channels))
    sizes = CONFIG.latent
    latent = LatentState(jnp.tanh(draw(1, sizes.deterministic_channels)), draw(2, sizes.stochastic_channels))
    route_map = jnp.zeros((STARTS, 64, 64), jnp.uint8).at[:, :, 30:34].set(255)
    return environment_lib.StartBank(latent, jnp.linspace(2.0, 8.0, STARTS), route_map)


def make(horizon=HORIZON, **options):
    """(environment, params); without occupancy in the reward unless asked otherwise, since decoding compiles long."""
    environment = environment_lib.Environment(MODEL, periods=2, **{"reward_config": NO_COLLISION} | options)
    return environment, environment.params(variables(), bank(), horizon)


def with_memory(windows=2, starts=STARTS, heads=("occupancy", "action")):
    """A model with a memory, a bank of states that were observed in as many windows, and the places of a window."""
    model = world_model.WorldModel(config_lib.override_all(presets.get("tiny"), {
        "model.first_guess": "last_seen", "model.heads": heads}).model)
    latent, places = model.initial_state(starts), memory_lib.stream_places(model.config)
    rows = jnp.arange(starts, dtype=jnp.int32) % windows
    return model, environment_lib.StartBank(latent, jnp.ones(starts), bank().route_map[:starts], memory_lib.empty(
        model.config, windows), rows), places


@dataclasses.dataclass(frozen=True)
class WallModel(world_model.WorldModel):
    """A world model written by hand for a straight road with a wall across it, so that occupancy means something.

    Metres to the wall and speed are the first two numbers of the latent. They are read off the observation (all ranges
    are the distance); full throttle adds 1 m/s in a step of 0.2 s. It has no variables.
    """

    def encode(self, variables, batch, *, train=False, keys=None, axis_name=None):
        seen = jnp.stack([batch.range_view[..., 3].mean(axis=(-2, -1)), batch.speed_mps], axis=-1)
        return _padded(seen, self.config.latent.embedding_channels), {}

    def observe_step(self, variables, noise, state, action, embedding, is_first):
        posterior = Gaussian(jnp.zeros_like(state.stochastic), jnp.ones_like(state.stochastic))
        deterministic = _padded(embedding[..., :2], self.config.latent.deterministic_channels)
        return LatentState(deterministic, posterior.mean), (posterior, posterior)

    def imagine_step(self, variables, noise, state, action):
        prior = Gaussian(jnp.zeros_like(state.stochastic), jnp.ones_like(state.stochastic))
        gap_m, speed_mps = state.deterministic[..., 0], state.deterministic[..., 1]
        speed_mps = jnp.maximum(speed_mps + action[..., 0], 0.0)
        following = jnp.stack([gap_m - 0.2 * speed_mps, speed_mps], axis=-1)
        return LatentState(_padded(following, self.config.latent.deterministic_channels), prior.mean), prior

    def decode(self, variables, states, heads=None, memory=None, rows=None):
        """Sure of what is occupied: everything from the wall on."""
        grid, gap_m = self.config.voxels, states.features[..., 0]
        ahead_m = grid.origin_m[0] + grid.voxel_size_m * (np.arange(grid.shape[0]) + 0.5)
        ahead_m = jnp.asarray(ahead_m, jnp.float32).reshape((1,) * gap_m.ndim + (-1,))
        wall = 20.0 * (ahead_m - jnp.expand_dims(gap_m, -1))
        wall = jnp.broadcast_to(jnp.expand_dims(wall, (-2, -1)), (*gap_m.shape, *grid.shape))
        return Predictions({"occupancy": {1: jnp.stack([jnp.zeros_like(wall), wall], axis=-1)}})


def _padded(values, channels):
    return jnp.concatenate([values, jnp.zeros((*values.shape[:-1], channels - values.shape[-1]))], axis=-1)


WALL_MODEL = WallModel(dataclasses.replace(CONFIG, heads=("occupancy",), route=False))


def before_a_wall(gap_m, speed_mps, horizon, **reward):
    """(environment, params) whose only start lies so far from the wall."""
    environment = environment_lib.Environment(WALL_MODEL, periods=2, reward_config=rewards.RewardConfig(**reward))
    start = WALL_MODEL.initial_state(1)
    start = dataclasses.replace(start, deterministic=start.deterministic.at[0, :2].set((gap_m, speed_mps)))
    starts = environment_lib.StartBank(start, jnp.full((1,), speed_mps), None)
    return environment, environment.params({}, starts, horizon)
