"""Worlds of a few pixels in which only the action decides what comes next, and a model that is trained on one of them.

They take seconds, so that "learns" and "obeys" are tests and not hopes.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.agents import sensitivity
from muvo_jax.model import rollout, world_model
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

FRAMES, SEEN = 6, 2  # of a window: all, and those that are observed
WINDOWS = 16
SIDE_PX = 32
GEOMETRY = config_lib.RangeViewGeometry(rows=SIDE_PX, columns=SIDE_PX)


class Bar:
    """A bright bar in a dark picture; steering moves it sideways by up to 4 pixels a step."""

    head = "image"
    contrast = ((0.0, -0.5), (0.0, 0.5))
    sensors = {"camera": "wob", "lidar": "none"}

    @staticmethod
    def starts(generator, count):
        return generator.uniform(10.0, SIDE_PX - 10.0, count)

    @staticmethod
    def step(place_px, action):
        return np.clip(place_px + 4.0 * action[..., 1], 2.0, SIDE_PX - 2.0)

    @staticmethod
    def show(place_px):
        """uint8 [..., 32, 32, 3]."""
        columns = np.arange(SIDE_PX) + 0.5
        line = 20.0 + 200.0 * np.exp(-0.5 * ((columns - place_px[..., None]) / 3.0) ** 2)
        return np.broadcast_to(line[..., None, :, None], (*place_px.shape, SIDE_PX, SIDE_PX, 3)).astype(np.uint8)


class Wall:
    """A wall all around, as far away everywhere; the throttle brings it nearer by up to 3 m a step."""

    head = "range_view"
    contrast = ((-0.5, 0.0), (0.5, 0.0))
    sensors = {"camera": "none", "lidar": "rv"}

    @staticmethod
    def starts(generator, count):
        return generator.uniform(15.0, 35.0, count)

    @staticmethod
    def step(distance_m, action):
        return np.clip(distance_m - 5.0 * action[..., 0], 3.0, 50.0)

    @staticmethod
    def show(distance_m):
        """float32 [..., 32, 32, 4]."""
        yaw_rad = np.pi * (1.0 - 2.0 * (np.arange(SIDE_PX) + 0.5) / SIDE_PX)
        beams = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad, 1 + 0 * yaw_rad], axis=-1)
        view = distance_m[..., None, None, None] * beams[None]
        return np.broadcast_to(view, (*distance_m.shape, SIDE_PX, SIDE_PX, 4)).astype(np.float32)


def config_of(world, latent, steps, **model):
    tiny = presets.tiny()
    small = dataclasses.replace(tiny.model, latent=latent, heads=(world.head,), route=False, speed=False,
                                image_size=(SIDE_PX, SIDE_PX), range_view=GEOMETRY, token_channels=24,
                                transformer_hidden_channels=48, fused_channels=32, embedding_channels=32,
                                deterministic_channels=32, stochastic_channels=16, decoder_channels=16,
                                keep_cells=True, aligned_tokens=latent == "2d", dropout=0.0,
                                backbone_width=8, prior_dropout=0.0,
                                **world.sensors, **model)
    loss = config_lib.LossConfig(image=1.0, image_squared=8.0, range_xyz=1.0, range_depth=2.0, kl=1e-4)
    return dataclasses.replace(
        tiny, model=small, loss=loss,
        optimizer=config_lib.OptimizerConfig(learning_rate=3e-3, warmup_fraction=0.1, clip_norm=10.0),
        data=dataclasses.replace(tiny.data, frames=FRAMES, context=SEEN, horizon=FRAMES - SEEN),
        train=dataclasses.replace(tiny.train, steps=steps, batch=WINDOWS, observe_frames=SEEN, decode_frames=2))


def windows(world, generator, count, action=None):
    """Windows of random actions, as types.Batch; `action` [count, FRAMES, 2] instead of random ones."""
    state, shown = world.starts(generator, count), []
    if action is None:
        action = generator.uniform(-1.0, 1.0, (count, FRAMES, 2)).astype(np.float32)
    for frame in range(FRAMES):
        shown.append(world.show(state))
        state = world.step(state, action[:, frame])
    is_first = np.zeros((count, FRAMES), bool)
    is_first[:, 0] = True
    extra = {"intrinsics": np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3)),
             "camera_to_ego": np.broadcast_to(np.eye(4, dtype=np.float32), (count, 4, 4))}
    return types.Batch(action=action, is_first=is_first, **{world.head: np.stack(shown, axis=1)}, **extra)


def trained(world, config, batch_of):
    """(model, variables, last metrics) after config.train.steps real training steps on batch_of(step)."""
    model = world_model.WorldModel(config.model)
    optimizer = optimizer_lib.make_optimizer(config.optimizer, config.train.steps)
    step = step_lib.make_train_step(model, config, parallel="pmap", devices=jax.devices()[:1])
    state = state_lib.create(model.init(jax.random.key(0), batch_of(0)[:1]), optimizer, jax.random.key(1))
    for index in range(config.train.steps):
        state, metrics = step(state, batch_of(index))
    return model, state.variables, {name: float(value) for name, value in metrics.items()}


def imagined(model, variables, batch, plans, head):
    """What is imagined under plans [B, N, H, 2] after the observed frames: [B, N, H, ...]."""
    observed = rollout.observe(model, variables, jax.random.key(2), batch.time_slice(0, SEEN), sampled=False)
    dream = rollout.imagine(model, variables, jax.random.key(3), observed.last, jnp.asarray(plans), sampled=False)
    return np.asarray(rollout.decode(model, variables, dream, (head,))[head][1])


def answer(world, model, variables):
    """(gain and correlation of the contrast, error of imagined frames, error of the last observed frame)."""
    generator = np.random.default_rng(99)
    batch = windows(world, generator, WINDOWS)
    recorded = batch.action[:, SEEN - 1:-1]
    pair = [np.broadcast_to(np.float32(action), recorded.shape) for action in world.contrast]
    frames = imagined(model, variables, batch, np.stack([recorded, *pair], axis=1), world.head)
    shown = []
    for plan in pair:
        held = batch.action.copy()
        held[:, SEEN - 1:-1] = plan
        other = windows(world, np.random.default_rng(99), WINDOWS, held)
        shown.append(np.asarray(getattr(other, world.head))[:, SEEN:])
    return frames, batch, shown


def scores(world, model, variables):
    frames, batch, shown = answer(world, model, variables)
    found = sensitivity.score(world.head, [frames[:, 1], frames[:, 2]], shown)
    truth = np.asarray(getattr(batch, world.head), np.float32)
    if world.head == "image":
        truth = truth / 255.0
    else:
        truth, frames = truth[..., 3], frames[..., 3]
    error = np.square(frames[:, 0] - truth[:, SEEN:]).mean()
    copied = np.square(truth[:, SEEN - 1:SEEN] - truth[:, SEEN:]).mean()
    return found | {"error": float(error), "copied": float(copied)}
