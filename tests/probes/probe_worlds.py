"""Worlds of a few pixels in which only the action decides what comes next, and a small model that is trained on one.

So that "learns" and "obeys" are tests and not hopes. The training step, the transition, the memory
and the decoders are the library's, in the town's recipe; encoders of two dense layers stand in for ResNets, whose
compilation alone would take longer than all the rest.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.agents import sensitivity
from muvo_jax.metrics import baselines
from muvo_jax.model import encoders, rollout, world_model
from muvo_jax.nn import layers
from muvo_jax.ops import conv_cpu
from muvo_jax.ops import range_view as range_view_ops
from muvo_jax.training import first_guess
from muvo_jax.training import optimizer as optimizer_lib
from muvo_jax.training import state as state_lib
from muvo_jax.training import step as step_lib

FRAMES, SEEN = 6, 2  # of a window: all, and those that are observed
WINDOWS, BATCHES = 16, 64  # in a batch, and batches that differ
STEPS = 200  # of training
SIDE_PX = 32
LIDAR = config_lib.RangeViewGeometry(rows=SIDE_PX, columns=SIDE_PX, elevation_min_rad=0.0, elevation_max_rad=0.3,
                                     position_m=(0.0, 0.0, 2.0))
BEAMS = range_view_ops.beam_directions(LIDAR)
AHEAD = BEAMS[..., 0] > 0.7  # the beams that meet the wall
MIDDLE = np.flatnonzero(AHEAD[0])[1:-1]  # columns
INTRINSICS = np.array([[16.0, 0.0, 16.0], [0.0, 16.0, 16.0], [0.0, 0.0, 1.0]], np.float32)
CAMERA_TO_EGO = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]], np.float32)


LATENTS = {"1d": config_lib.VectorLatent(fused_channels=32, keep_cells=True, embedding_channels=32,
                                         deterministic_channels=32, stochastic_channels=16, action_channels=8,
                                         occupancy_blocks=1),
           "2d": config_lib.TokenLatent(transition_layers=1, aligned_tokens=True, occupancy_token_stages=0)}


@dataclasses.dataclass(frozen=True)
class Bar:
    """A bright bar in a dark picture; steering moves it sideways by up to 4 pixels a step.

    The car stands on its brake, so that the memory shows the bar where it was: the latent must tell where it is now.
    The state is its place.
    """

    head: str = "image"
    camera: config_lib.PlaneCamera | None = config_lib.PlaneCamera()
    heads: tuple = ("image",)
    kinematics: str = "bicycle"
    contrast: tuple = ((0.0, -0.5), (0.0, 0.5))

    def lidar(self, memory):
        return config_lib.RangeViewLidar() if memory else None  # nothing is moved without ranges

    def steps(self, memory):
        return STEPS if memory else STEPS + STEPS // 2

    def starts(self, generator, count):
        return generator.uniform(10.0, SIDE_PX - 10.0, count)

    def plans(self, generator, count):
        action = generator.uniform(-1.0, 1.0, (count, FRAMES, 2)).astype(np.float32)
        return np.stack([-np.abs(action[..., 0]), action[..., 1]], axis=-1)

    def step(self, place_px, action):
        return np.clip(place_px + 4.0 * action[..., 1], 2.0, SIDE_PX - 2.0)

    def fields(self, place_px):
        """Of types.Batch, for places [B, T]."""
        columns = np.arange(SIDE_PX) + 0.5
        line = 20.0 + 200.0 * np.exp(-0.5 * ((columns - place_px[..., None]) / 3.0) ** 2)
        image = np.broadcast_to(line[..., None, :, None], (*place_px.shape, SIDE_PX, SIDE_PX, 3)).astype(np.uint8)
        return {"image": image, "range_view": wall_ahead(np.full_like(place_px, 20.0)),
                "speed_mps": np.zeros(place_px.shape, np.float32)}

    def judged(self, images):
        return images

    def shown(self, decoded_or_recorded):
        """What is compared: brightness in [0, 1]."""
        value = np.asarray(decoded_or_recorded)
        return value / 255.0 if value.dtype == np.uint8 else value


@dataclasses.dataclass(frozen=True)
class Wall:
    """A wall across the road; the throttle brings the car nearer by up to 5 m a step. The state is its distance.

    How far the car comes is no bicycle's doing: a model with memory must learn it (the head ego_motion).
    """

    head: str = "range_view"
    camera: config_lib.PlaneCamera | None = None
    heads: tuple = ("range_view", "ego_motion")
    kinematics: str = "none"
    contrast: tuple = ((-0.5, 0.0), (0.5, 0.0))

    def lidar(self, memory):
        del memory
        return config_lib.RangeViewLidar()

    def steps(self, memory):
        return STEPS if memory else 6 * STEPS  # ranges come from an L1 alone, which nears them as slowly as it steps

    def starts(self, generator, count):
        return generator.uniform(30.0, 45.0, count)

    def plans(self, generator, count):
        return generator.uniform(-1.0, 1.0, (count, FRAMES, 2)).astype(np.float32)

    def step(self, distance_m, action):
        return distance_m - 2.5 * (1.0 + action[..., 0])

    def fields(self, distance_m):
        """Of types.Batch, for distances [B, T]."""
        forward_m = -np.diff(distance_m, axis=1, prepend=distance_m[:, :1])
        nothing = np.zeros_like(forward_m)
        ego_motion = np.stack([forward_m, nothing, nothing, 5.0 * forward_m], axis=-1).astype(np.float32)
        return {"range_view": wall_ahead(distance_m), "ego_motion": ego_motion}

    def judged(self, range_views):
        """All but the wall's ends. It is seen 45 degrees to either side from wherever the car is, as no wall is: memory
        shows its ends beside it once the car has come nearer, and how often they still flicker after 200 steps is
        chance, while one lost return weighs as much as ten metres of a hundred beams.
        """
        return range_views[..., MIDDLE, :]

    def shown(self, decoded_or_recorded):
        """What is compared: ranges in metres."""
        return self.judged(np.asarray(decoded_or_recorded))[..., 3]


def wall_ahead(distance_m):
    """float32 [..., 32, 32, 4]: what the lidar sees of a wall across the road, up to 45 degrees to either side."""
    range_m = distance_m[..., None, None] / np.where(AHEAD, BEAMS[..., 0], 1.0)
    points_m = range_m[..., None] * BEAMS + np.array(LIDAR.position_m)
    view = np.concatenate([points_m, range_m[..., None]], axis=-1)
    return np.where(AHEAD[..., None], view, (0.0, 0.0, 0.0, types.RANGE_NO_RETURN_M)).astype(np.float32)


class PatchCamera(encoders.PlaneEncoder):
    """[N, H/32, W/32, C], as PlaneCamera."""

    @linen.compact
    def __call__(self, frames, mode):
        del mode
        return patches(encoders.normalise_image(frames["image"]), 32, self.config.fusion.token_channels)


class PatchLidar(encoders.RangeViewEncoder):
    """[N, Hr/32, Wr/32, C], /16 for the 2D latent, as RangeViewLidar."""

    @linen.compact
    def __call__(self, frames, mode):
        del mode
        size = 16 if isinstance(self.config.latent, config_lib.TokenLatent) else 32
        return patches(frames["range_view"] / self.config.range_scale_m, size, self.config.fusion.token_channels)


def patches(x, size, channels):
    """Two dense layers on patches of so many pixels, to be called in a compact method."""
    x = layers.Dense(64, name="first")(conv_cpu.space_to_depth(x, (size, size)))
    return layers.Dense(channels, name="second")(jax.nn.relu(x))


def config_of(world, latent, memory):
    """A small model of the sensors that the world has, in the town's recipe."""
    tiny = presets.tiny()
    small = dataclasses.replace(
        tiny.model, latent=LATENTS[latent], heads=world.heads, camera=world.camera, lidar=world.lidar(memory),
        route=False, speed=False, image_size=(SIDE_PX, SIDE_PX), range_view=LIDAR, decoder_channels=32,
        fusion=config_lib.TransformerFusion(token_channels=24, layers=1, heads=2, hidden_channels=48, dropout=0.0),
        prior_dropout=0.0, action_path="recurrence", range_view_points="beams",
        first_guess=config_lib.LastSeen(memory_frames=2, guided_channels=(32, 32, 32)) if memory else
        config_lib.TrainingMean())
    return dataclasses.replace(
        tiny, model=small, contract=config_lib.ActionContract(kinematics=world.kinematics),
        loss=config_lib.LossConfig(image=1.0, image_squared=8.0, range_xyz=1.0, range_depth=2.0, ego_motion=0.2,
                                   kl=1e-4),
        optimizer=config_lib.OptimizerConfig(learning_rate=3e-3, warmup_fraction=0.1, clip_norm=10.0),
        data=dataclasses.replace(tiny.data, frames=FRAMES, context=SEEN, horizon=FRAMES - SEEN),
        train=dataclasses.replace(tiny.train, steps=world.steps(memory), batch=WINDOWS, observe_frames=SEEN,
                                  decode_frames=2))


def windows(world, seed, count=WINDOWS, action=None):
    """types.Batch of windows under random actions, or under `action` [count, FRAMES, 2] from the same starts."""
    generator = np.random.default_rng(seed)
    states = [world.starts(generator, count)]
    if action is None:
        action = world.plans(generator, count)
    for frame in range(FRAMES - 1):
        states.append(world.step(states[-1], action[:, frame]))
    is_first = np.zeros((count, FRAMES), bool)
    is_first[:, 0] = True
    spread = lambda value: np.broadcast_to(value, (count, *value.shape))
    return types.Batch(action=action, is_first=is_first, intrinsics=spread(INTRINSICS),
                       camera_to_ego=spread(CAMERA_TO_EGO), **world.fields(np.stack(states, axis=1)))


class Trainer:
    """A model and its compiled training step, which every training of the same config shares."""

    def __init__(self, world, config):
        self.world, self.config = world, config
        self.model = world_model.WorldModel(config.model)
        self._step = step_lib.make_train_step(self.model, config, devices=jax.devices()[:1])
        self._create = jax.jit(functools.partial(
            state_lib.create, optimizer=optimizer_lib.make_optimizer(config.optimizer, config.train.steps)))

    def train(self, batches):
        """Variables after config.train.steps real training steps, on one of the batches after the other."""
        mean = functools.reduce(baselines.TrainingMean.add, batches, baselines.TrainingMean())
        state = self._create(self.model.init(jax.random.key(0), batches[0]), key=jax.random.key(1))
        state = first_guess.fill(state, mean, self.config.model, self._step.plan)
        for index in range(self.config.train.steps):
            state, _ = self._step(state, batches[index % len(batches)])
        return jax.device_get(state.variables)

    def observe(self, variables, batch):
        return rollout.observe(self.model, variables, jax.random.key(2), batch, sampled=False)

    def decode(self, variables, states, memory):
        """What is shown of states: [*L, ...] as `world.shown`."""
        head = self.world.head
        return self.world.shown(rollout.decode(self.model, variables, states, (head,), memory=memory)[head])

    def imagine(self, variables, batch, plans):
        """What is imagined after the observed frames under plans [B, N, H, 2]: [B, N, H, ...] as `world.shown`."""
        observed = self.observe(variables, batch.time_slice(0, SEEN))
        dream = rollout.imagine(self.model, variables, jax.random.key(3), observed.last, jnp.asarray(plans),
                                sampled=False)
        return self.decode(variables, dream.states, observed.memory)


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
        true.append(world.judged(np.asarray(getattr(windows(world, seed, action=action), world.head)))[:, SEEN:])
    truth = world.shown(getattr(batch, world.head))
    error = lambda guess: float(np.square(guess - truth[:, SEEN:]).mean())
    return sensitivity.score(world.head, [imagined[:, 1], imagined[:, 2]], true) | {
        "imagined": error(imagined[:, 0]), "copied": error(truth[:, SEEN - 1:SEEN])}
