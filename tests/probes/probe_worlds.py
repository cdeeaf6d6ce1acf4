"""Worlds of a few pixels in which only the action decides what comes next, and a small model that is trained on one.

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
WINDOWS, BATCHES = 16, 64  # in a batch, and batches that differ
SIDE_PX = 32
GEOMETRY = config_lib.RangeViewGeometry(rows=SIDE_PX, columns=SIDE_PX)
LATENTS = {"1d": config_lib.VectorLatent(embedding_channels=32, fused_channels=32, keep_cells=True,
                                         deterministic_channels=32, stochastic_channels=16, action_channels=8,
                                         occupancy_blocks=1),
           "2d": config_lib.TokenLatent(transition_layers=1, aligned_tokens=True, occupancy_token_stages=0)}


@dataclasses.dataclass(frozen=True)
class Bar:
    """A bright bar in a dark picture; steering moves it sideways by up to 4 pixels a step. The state is its place."""

    head: str = "image"
    camera: config_lib.PlaneCamera | None = config_lib.PlaneCamera()
    lidar: config_lib.RangeViewLidar | None = None
    contrast: tuple = ((0.0, -0.5), (0.0, 0.5))

    def starts(self, generator, count):
        return generator.uniform(10.0, SIDE_PX - 10.0, count)

    def step(self, place_px, action):
        return np.clip(place_px + 4.0 * action[..., 1], 2.0, SIDE_PX - 2.0)

    def show(self, place_px):
        """uint8 [..., 32, 32, 3]."""
        columns = np.arange(SIDE_PX) + 0.5
        line = 20.0 + 200.0 * np.exp(-0.5 * ((columns - place_px[..., None]) / 3.0) ** 2)
        return np.broadcast_to(line[..., None, :, None], (*place_px.shape, SIDE_PX, SIDE_PX, 3)).astype(np.uint8)

    def shown(self, decoded_or_recorded):
        """What is compared: brightness in [0, 1]."""
        value = np.asarray(decoded_or_recorded)
        return value / 255.0 if value.dtype == np.uint8 else value


@dataclasses.dataclass(frozen=True)
class Wall:
    """A round wall; the throttle brings it nearer by up to 5 m a step. The state is its distance."""

    head: str = "range_view"
    camera: config_lib.PlaneCamera | None = None
    lidar: config_lib.RangeViewLidar | None = config_lib.RangeViewLidar()
    contrast: tuple = ((-0.5, 0.0), (0.5, 0.0))

    def starts(self, generator, count):
        return generator.uniform(15.0, 35.0, count)

    def step(self, distance_m, action):
        return np.clip(distance_m - 5.0 * action[..., 0], 3.0, 50.0)

    def show(self, distance_m):
        """float32 [..., 32, 32, 4]."""
        yaw_rad = np.pi * (1.0 - 2.0 * (np.arange(SIDE_PX) + 0.5) / SIDE_PX)
        beams = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad, 1 + 0 * yaw_rad], axis=-1)
        view = distance_m[..., None, None, None] * beams[None]
        return np.broadcast_to(view, (*distance_m.shape, SIDE_PX, SIDE_PX, 4)).astype(np.float32)

    def shown(self, decoded_or_recorded):
        """What is compared: ranges in metres."""
        return np.asarray(decoded_or_recorded)[..., 3]


def config_of(world, latent, steps=200, **model):
    """A small model of the sensor that the world has; `model` changes fields of ModelConfig."""
    tiny = presets.tiny()
    small = dataclasses.replace(
        tiny.model, latent=LATENTS[latent], heads=(world.head,), camera=world.camera, lidar=world.lidar, route=False,
        speed=False, image_size=(SIDE_PX, SIDE_PX), range_view=GEOMETRY, backbone_width=8, decoder_channels=16,
        fusion=config_lib.TransformerFusion(token_channels=24, layers=1, heads=2, hidden_channels=48, dropout=0.0),
        **{"prior_dropout": 0.0, **model})
    return dataclasses.replace(
        tiny, model=small,
        loss=config_lib.LossConfig(image=1.0, image_squared=8.0, range_xyz=1.0, range_depth=2.0, kl=1e-4),
        optimizer=config_lib.OptimizerConfig(learning_rate=3e-3, warmup_fraction=0.1, clip_norm=10.0),
        data=dataclasses.replace(tiny.data, frames=FRAMES, context=SEEN, horizon=FRAMES - SEEN),
        train=dataclasses.replace(tiny.train, steps=steps, batch=WINDOWS, observe_frames=SEEN, decode_frames=2))


def windows(world, seed, count=WINDOWS, action=None):
    """types.Batch of windows under random actions, or under `action` [count, FRAMES, 2] from the same starts."""
    generator = np.random.default_rng(seed)
    state, shown = world.starts(generator, count), []
    if action is None:
        action = generator.uniform(-1.0, 1.0, (count, FRAMES, 2)).astype(np.float32)
    for frame in range(FRAMES):
        shown.append(world.show(state))
        state = world.step(state, action[:, frame])
    is_first = np.zeros((count, FRAMES), bool)
    is_first[:, 0] = True
    calibration = {name: np.broadcast_to(np.eye(side, dtype=np.float32), (count, side, side))
                   for name, side in (("intrinsics", 3), ("camera_to_ego", 4))}
    return types.Batch(action=action, is_first=is_first, **{world.head: np.stack(shown, axis=1)}, **calibration)


class Trainer:
    """A model and its compiled training step, which every training of the same config shares."""

    def __init__(self, world, config):
        self.world, self.config = world, config
        self.model = world_model.WorldModel(config.model)
        self._step = step_lib.make_train_step(self.model, config, parallel="pmap", devices=jax.devices()[:1])

    def train(self, batch_of):
        """Variables after config.train.steps real training steps on batch_of(step)."""
        optimizer = optimizer_lib.make_optimizer(self.config.optimizer, self.config.train.steps)
        variables = self.model.init(jax.random.key(0), batch_of(0)[:1])
        state = state_lib.create(variables, optimizer, jax.random.key(1))
        for index in range(self.config.train.steps):
            state, _ = self._step(state, batch_of(index))
        return jax.device_get(state.variables)

    def imagine(self, variables, batch, plans):
        """What is imagined after the observed frames under plans [B, N, H, 2]: [B, N, H, ...] as `world.shown`."""
        observed = rollout.observe(self.model, variables, jax.random.key(2), batch.time_slice(0, SEEN), sampled=False)
        dream = rollout.imagine(self.model, variables, jax.random.key(3), observed.last, jnp.asarray(plans),
                                sampled=False)
        return self.world.shown(rollout.decode(self.model, variables, dream, (self.world.head,))[self.world.head])


def judge(trainer, variables):
    """{"gain", "correlation"} of the world's contrast, and squared errors of the imagined frames of unseen windows
    ("imagined") and of the last observed one in their place ("copied")."""
    world, seed = trainer.world, 10_000
    batch = windows(world, seed)
    recorded = batch.action[:, SEEN - 1:-1]
    plans = [recorded, *(np.broadcast_to(np.float32(action), recorded.shape) for action in world.contrast)]
    imagined = trainer.imagine(variables, batch, np.stack(plans, axis=1))
    true = []
    for plan in plans[1:]:
        action = batch.action.copy()
        action[:, SEEN - 1:-1] = plan
        true.append(np.asarray(getattr(windows(world, seed, action=action), world.head))[:, SEEN:])
    truth = world.shown(getattr(batch, world.head))
    error = lambda guess: float(np.square(guess - truth[:, SEEN:]).mean())
    return sensitivity.score(world.head, [imagined[:, 1], imagined[:, 2]], true) | {
        "imagined": error(imagined[:, 0]), "copied": error(truth[:, SEEN - 1:SEEN])}
