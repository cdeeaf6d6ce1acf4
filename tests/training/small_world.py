"""A model with the interface and the randomness of WorldModel, but small enough to compile in seconds; and its batches.

The transition is the real one. The encoder keeps what matters to spreading a batch over devices: convolutions in front
of a synchronised BatchNorm, and dropout keyed per sample. The decoders are single dense layers.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from muvo_jax import presets, types
from muvo_jax.model import latents
from muvo_jax.nn import attention, layers, norm
from muvo_jax.objectives import labels

WINDOWS = 8


class SmallNetwork(linen.Module):
    config: object

    def setup(self):
        self.transition = latents.VectorTransition(self.config)
        self.convolution = layers.Conv(4, (3, 3), layers.Compute(convolution="xla"), stride=2)
        self.range_convolution = layers.Conv(4, (3, 3), layers.Compute(convolution="xla"), stride=2)
        self.norm, self.range_norm = norm.BatchNorm(), norm.BatchNorm()
        self.embed = layers.Dense(self.config.latent.embedding_channels)
        self.heads = {name: {scale: layers.Dense(int(np.prod(shape))) for scale, shape in shapes.items()}
                      for name, shapes in head_shapes(self.config).items()}

    def encode(self, image, range_view, mode, keys):
        image = jax.nn.relu(self.norm(self.convolution(image.astype(jnp.float32) / 255), mode))
        range_view = jax.nn.relu(self.range_norm(self.range_convolution(range_view / 50), mode))
        pooled = [jnp.concatenate([value.mean(axis=(1, 2)), jnp.square(value).mean(axis=(1, 2))], axis=-1)
                  for value in (image, range_view)]
        return self.embed(attention.dropout(jnp.concatenate(pooled, axis=-1), keys, 0, self.config.fusion.dropout))

    def observe_step(self, *args):
        return self.transition.observe_step(*args)

    def imagine_step(self, *args):
        return self.transition.imagine_step(*args)

    def decode(self, features, names):
        shapes = head_shapes(self.config)
        return {name: {scale: self.heads[name][scale](features).reshape(*features.shape[:-1], *shape)
                       for scale, shape in shapes[name].items()} for name in names}

    def everything(self, image, range_view, noise, action, state, is_first):
        embedding = self.encode(image, range_view, norm.Mode(), None)
        return self.decode(self.observe_step(noise, state, action, embedding, is_first)[0].features, self.config.heads)


@dataclasses.dataclass(frozen=True)
class SmallWorld:
    """What muvo_jax.training asks of a model."""

    config: object

    def init(self, seed=0):
        shapes = jax.eval_shape(functools.partial(SmallNetwork(self.config).init, method="everything"),
                                jax.random.key(0), *self._example())
        generator = np.random.default_rng(seed)
        fill = lambda leaf: (0.1 * generator.normal(size=leaf.shape)).astype(np.float32)
        unit = lambda leaf: np.ones(leaf.shape, np.float32)
        return {"params": jax.tree.map(fill, shapes["params"]),
                "batch_stats": jax.tree.map(unit, shapes["batch_stats"])}

    def variable_shapes(self):
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), SmallWorld.init(self))

    def _example(self):
        batch, state = make_batch(self.config, frames=1), self.initial_state(WINDOWS)
        noise = types.StepNoise(state.stochastic, state.stochastic, jnp.zeros(WINDOWS, bool))
        return batch.image[:, 0], batch.range_view[:, 0], noise, batch.action[:, 0], state, batch.is_first[:, 0]

    def initial_state(self, batch_size):
        return latents.VectorTransition.initial_state(self.config, batch_size)

    def encode(self, variables, batch, *, train, keys, axis_name):
        merge = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])
        frame_keys = jax.vmap(lambda key: jax.random.split(key, batch.frames))(keys).reshape(-1) if train else None
        embedding, updated = SmallNetwork(self.config).apply(
            variables, merge(batch.image), merge(batch.range_view), norm.Mode(train, axis_name), frame_keys,
            method="encode", mutable=["batch_stats"])
        return embedding.reshape(*batch.action.shape[:2], -1), updated["batch_stats"]

    def observe_step(self, variables, *args):
        return SmallNetwork(self.config).apply(variables, *args, method="observe_step")

    def imagine_step(self, variables, *args):
        return SmallNetwork(self.config).apply(variables, *args, method="imagine_step")

    def decode(self, variables, states, heads=None, memory=None, rows=None):
        assert memory is None and rows is None, "the small world has no geometric memory"
        features = states.features if isinstance(states, types.LatentState) else states
        names = self.config.heads if heads is None else heads
        return types.Predictions(SmallNetwork(self.config).apply(variables, features, names, method="decode"))


def head_shapes(config):
    """{head: {scale: shape of one frame}}."""
    plane = lambda rows, columns, channels: {f: (rows // f, columns // f, channels) for f in labels.SCALES}
    known = {"image": plane(*config.image_size, 3),
             "range_view": plane(config.range_view.rows, config.range_view.columns, 4),
             "occupancy": {f: (*(side // f for side in config.voxels.shape), 2) for f in labels.SCALES},
             "action": {1: (2,)}}
    return {name: known[name] for name in config.heads}


def make_config(accumulate=1, **model):
    """The tiny preset for WINDOWS windows an update, with everything random and every loss term switched on.

    Of three frames the last is imagined, and two are decoded.
    """
    config = presets.tiny()
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, fusion=dataclasses.replace(config.model.fusion, dropout=0.2),
                                  prior_dropout=0.5, **model),
        data=dataclasses.replace(config.data, frames=3),
        augmentation=dataclasses.replace(config.augmentation, image=True),
        train=dataclasses.replace(config.train, batch=WINDOWS // accumulate, observe_frames=2, decode_frames=2),
        optimizer=dataclasses.replace(config.optimizer, accumulate=accumulate),
        loss=dataclasses.replace(config.loss, image_squared=0.1, image_instance=0.05, chamfer=0.1, chamfer_points=16))


def make_batch(model_config, frames=3, seed=0):
    """Random windows; window i has more holes, unknown voxels and masked pixels than i - 1, and window 0 has none."""
    generator = np.random.default_rng(seed)
    prefix, share = (WINDOWS, frames), np.linspace(0.0, 0.9, WINDOWS)
    rows, columns = model_config.range_view.rows, model_config.range_view.columns
    points = generator.normal(size=(*prefix, rows, columns, 3)).astype(np.float32) * 10
    range_view = np.concatenate([points, np.linalg.norm(points, axis=-1, keepdims=True)], axis=-1)
    holes = generator.random((*prefix, rows, columns)) < share[:, None, None, None]
    range_view[holes] = (0, 0, 0, types.RANGE_NO_RETURN_M)
    voxels = generator.random((*prefix, *model_config.voxels.shape))
    occupancy = (voxels < 0.1).astype(np.uint8)
    unknown = generator.random(voxels.shape) < share[:, None, None, None, None]
    occupancy[unknown] = types.OCCUPANCY_UNKNOWN
    return types.Batch(
        action=generator.uniform(-1, 1, (*prefix, 2)).astype(np.float32),
        is_first=np.broadcast_to(np.arange(frames) == 0, prefix).copy(),
        image=generator.integers(0, 256, (*prefix, *model_config.image_size, 3), np.uint8),
        range_view=range_view, occupancy=occupancy,
        route_map=generator.integers(0, 2, (*prefix, 64, 64), np.uint8) * np.uint8(255),
        speed_mps=generator.uniform(0, 10, prefix).astype(np.float32),
        image_instance_mask=generator.random((*prefix, *model_config.image_size)) < share[:, None, None, None],
    ).validate()
