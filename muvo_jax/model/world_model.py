"""The world model: five pure functions over explicit variables, composed from the parts that the configuration names.

    encode        observations -> embedding per frame
    observe_step  noise, state, previous action, embedding -> next state (filtering)
    imagine_step  noise, state, action -> next state (prediction)
    decode        latent features -> images, range views, occupancy, actions
    init          fresh variables

This is the inner layer: its steps take the noise itself and are as deterministic as the rest. The functions of
rollout.py and live.py, which muvo_jax names, take (model, variables, key, ...), draw the noise and check what comes in.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen

from muvo_jax import head as head_lib
from muvo_jax.config import KNOWN_HEADS, ModelConfig, TokenLatent, TransformerFusion, ZeroGuess
from muvo_jax.model import decoders, encoders, fusion, glimpse, guided, latents, tokens
from muvo_jax.model import memory as memory_lib
from muvo_jax.nn import init as init_lib
from muvo_jax.nn import norm
from muvo_jax.types import (
    BATCH_FIELDS,
    UNTIMED_FIELDS,
    Batch,
    Gaussian,
    LatentState,
    Memory,
    Motion,
    Predictions,
    StepNoise,
    Vantage,
    Variables,
)

ROUTE_MAP_SIZE = (64, 64)


class Network(linen.Module):
    """What stands around the transition: from frames to embeddings, from states to outputs."""

    config: ModelConfig

    def setup(self):
        config = self.config
        if config.camera is not None:
            self.camera = encoders.CAMERAS[type(config.camera)](config)
        if config.lidar is not None:
            self.lidar = encoders.LIDARS[type(config.lidar)](config)
        if config.route:
            self.route = encoders.ROUTE_ENCODERS[config.route_encoder](config)
        if config.navigation:
            self.command = encoders.CommandEncoder(config)
            self.next_command = encoders.CommandEncoder(config)
            self.target = encoders.TargetEncoder(config)
        if config.speed:
            self.speed = encoders.SpeedEncoder(config)
        self.fusion = fusion.REGISTRY[type(config.fusion)](config)
        guessed = memory_lib.guessed_heads(config)
        described = {name: head_lib.get(name) for name in KNOWN_HEADS if name in config.heads}
        self.decoders = {name: guided.GuidedHead(config, head.guide) if head.guide is not None and name in guessed
                         else head.build(config) for name, head in described.items()}
        if not isinstance(config.first_guess, ZeroGuess):
            self.first_guess = {name: decoders.FirstGuess() for name, head in described.items()
                                if head.average is not None}

    def encode(self, frames: dict[str, jax.Array], mode: norm.Mode, keys: jax.Array | None) -> jax.Array:
        measured = []
        if self.config.route:
            measured.append(self.route(frames["route_map"], mode))
        if self.config.navigation:
            measured += [self.command(frames["command"]), self.next_command(frames["next_command"]),
                         self.target(frames["target_m"], frames["next_target_m"])]
        if self.config.speed:
            measured.append(self.speed(frames["speed_mps"]))
        image_map = self.camera(frames, mode) if self.config.camera is not None else None
        lidar_map = self.lidar(frames, mode) if self.config.lidar is not None else None
        return self.fusion(image_map, lidar_map, measured, mode, keys)

    def decode(self, features: jax.Array, vantage: Vantage | None, memory: Memory | None, rows: jax.Array | None,
               names: tuple[str, ...]) -> dict[str, dict[int, jax.Array]]:
        glimpses: dict[str, glimpse.Glimpse] = {}
        numbers = None
        if memory is not None:
            assert vantage is not None and rows is not None  # as memory.check returns them
            glimpses, numbers = glimpse.look(self.config, memory, rows, vantage, names)
        raw = {}
        for name in names:
            read = self.read(features, name)
            if name in glimpses:
                raw[name] = self.decoders[name](read, glimpses[name], numbers, self.first_guess[name])
            else:
                raw[name] = self.decoders[name](read)
                if not isinstance(self.config.first_guess, ZeroGuess) and name in self.first_guess:
                    raw[name] = self.first_guess[name](raw[name])
        return raw

    def read(self, features: jax.Array, head: str) -> jax.Array:
        """What a head decodes of the features: with the 2D latent its group of tokens, or all of them pooled."""
        if not isinstance(self.config.latent, TokenLatent):
            return features
        group = head_lib.get(head).tokens
        return tokens.pool(features, self.config) if group is None else tokens.read(features, group, self.config)

    def everything(self, frames: dict[str, jax.Array], state: LatentState) -> jax.Array:
        """Touches every parameter once; only its shapes are ever computed. Returns the embedding."""
        memory = memory_lib.empty(self.config, 1)
        self.decode(state.features, state.vantage, memory, jnp.zeros((1,), jnp.int32), self.config.heads)
        return self.encode(frames, norm.Mode(), None)


@dataclasses.dataclass(frozen=True)
class WorldModel:
    """A frozen, hashable description of a model: pass it as a static argument under jit.

    All methods are pure, and all but `init` can be traced. `variables` is {"params": ..., "batch_stats": ...}, dicts.
    """

    config: ModelConfig

    def __post_init__(self):
        self.config.check_motion()

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """Shape of one state's LatentState.features, what decoders read: (D + S,), or (N, 2 C) with the 2D latent."""
        return jax.eval_shape(lambda: self.initial_state(1).features).shape[1:]

    def policy_features(self, features: jax.Array) -> jax.Array:
        """What a policy reads, one vector [..., P] whatever the latent, of LatentState.features [..., *feature_shape].

        With the 1D latent the features themselves; with the 2D latent the mean over the tokens of each group side by
        side, the action's token last (muvo_jax.model.tokens).
        """
        return tokens.pool(features, self.config) if isinstance(self.config.latent, TokenLatent) else features

    @property
    def policy_feature_channels(self) -> int:
        """P of `policy_features`."""
        return jax.eval_shape(self.policy_features, jax.ShapeDtypeStruct(self.feature_shape, jnp.float32)).shape[-1]

    def variable_shapes(self) -> dict[str, Any]:
        """The variables as jax.ShapeDtypeStruct leaves."""
        # The plain convolutions trace fastest, and the parameters do not depend on the form.
        return dict(_variable_shapes(dataclasses.replace(self.config, convolution="xla")))

    def init(self, key: jax.Array, batch: Batch | None = None) -> dict[str, Any]:
        """Fresh variables as float32 NumPy arrays; see muvo_jax.nn.init for the rules.

        Args:
          key: typed PRNG key; the same key gives the same numbers on every machine.
          batch: where given, checked against the configuration (shapes do not depend on it otherwise).

        Raises:
          ValueError: if the batch does not fit the configuration, or the key is traced: this runs on the host.
        """
        if batch is not None:
            self._frames(batch)
        constants = {**decoders.initial_constants(self.config), **guided.initial_constants(self.config),
                     **latents.initial_constants(self.config), **fusion.initial_constants(self.config)}
        return init_lib.fill(self.variable_shapes(), key, constants)

    def encode(self, variables: Variables, batch: Batch, *, train: bool = False, keys: jax.Array | None = None,
               axis_name: str | None = None) -> tuple[jax.Array, Variables]:
        """Embeds all frames jointly.

        Args:
          variables: of this model.
          batch: B windows of T frames.
          train: BatchNorm uses and updates the moments of this batch; dropout is on.
          keys: typed keys [B], one per sample, needed when train; frame t of a sample uses fold_in(key, t).
          axis_name: mapped axis over which the batch is split; BatchNorm is synchronised over it.

        Returns:
          embedding float32 [B, T, E], tokens [B, T, M, C] with the 2D latent, and the (updated) batch_stats.

        Raises:
          ValueError: if the batch lacks a modality or has other sizes than the configuration, or keys are missing.
        """
        frames = self._frames(batch)
        mode = norm.Mode(train, axis_name)
        frame_keys = None
        if train and isinstance(self.config.fusion, TransformerFusion) and self.config.fusion.dropout > 0.0:
            if keys is None or keys.shape != (batch.batch_size,):
                raise ValueError(f"encode(train=True): got keys {None if keys is None else keys.shape}, expected one "
                                 f"typed key per sample, shape ({batch.batch_size},), for the dropout masks.")
            steps = jnp.arange(batch.frames)
            frame_keys = jax.vmap(lambda key: jax.vmap(functools.partial(jax.random.fold_in, key))(steps))(keys)
            frame_keys = frame_keys.reshape(-1)
        batch_stats = variables["batch_stats"]
        if train:
            embedding, updated = self._apply(variables, "encode", frames, mode, frame_keys, mutable=["batch_stats"])
            batch_stats = updated["batch_stats"]
        else:
            embedding = self._apply(variables, "encode", frames, mode, None)
        return embedding.reshape(batch.batch_size, batch.frames, *embedding.shape[1:]), batch_stats

    def initial_state(self, batch_size: int) -> LatentState:
        """The zero state [batch_size, ...], before anything was seen."""
        return latents.TRANSITIONS[type(self.config.latent)].initial_state(self.config, batch_size)

    def observe_step(self, variables: Variables, noise: StepNoise, state: LatentState, action: jax.Array,
                     embedding: jax.Array, is_first: jax.Array) -> tuple[LatentState, tuple[Gaussian, Gaussian]]:
        """Moves the state one step and corrects it by an observation. Inner layer: see muvo_jax.observe_step.

        Args:
          variables: of this model.
          noise: StepNoise [B, ...]; zeros give the mean mode.
          state: LatentState [B, ...].
          action: [B, 2], the PREVIOUS action, applied between the last observation and this one.
          embedding: [B, E] ([B, M, C] with the 2D latent) of this observation.
          is_first: bool [B]; where true, state and action are replaced by zeros and the RSSM dropout is off.

        Returns:
          the state to go on from, and (prior, posterior). Its sample is the posterior's, or the prior's where
          noise.use_prior says so.
        """
        return self._move(variables, "observe_step", noise, state, action, embedding, is_first)

    def imagine_step(self, variables: Variables, noise: jax.Array, state: LatentState,
                     action: jax.Array) -> tuple[LatentState, Gaussian]:
        """Moves the state [B, ...] one step by action [B, 2] alone. Inner layer: see muvo_jax.imagine_step.

        noise: standard normal numbers of the shape of the stochastic state, or zeros.
        """
        following, prior = self._move(variables, "imagine_step", noise, state, action)
        if self.config.tracks_motion and self.config.kinematics is None:
            assert state.vantage is not None  # of a model that tracks its motion
            arrival = self.ego_motion(variables, following)
            vantage = memory_lib.moved_on(state.vantage, Motion(arrival[..., :3], arrival[..., 3]))
            following = dataclasses.replace(following, vantage=vantage)
        return following, prior

    def ego_motion(self, variables: Variables, states: LatentState) -> jax.Array:
        """What the head of that name says of states [*L, ...]: [*L, 4], as Batch.ego_motion."""
        return self.decode(variables, states.features, ("ego_motion",)).ego_motion

    def decode(self, variables: Variables, states: LatentState | jax.Array, heads: Sequence[str] | None = None,
               memory: Memory | None = None, rows: jax.Array | None = None) -> Predictions:
        """Decodes latent states with any leading axes.

        Args:
          variables: of this model.
          states: LatentState [...], or, where no head looks at a memory, LatentState.features [..., *feature_shape].
          memory: Memory of B drives, for a model with first_guess=LastSeen (Observed.memory, LiveState.memory).
          rows: int32 [...], the drive that each state belongs to; by default the first axis of the states counts them.
          heads: which ones; None for all that the model has. Only these are computed.

        Returns:
          Predictions, float32 [..., *size / scale, channels]: image in [0, 1] where trained (no clipping), range_view
          in metres, occupancy as logits [..., X, Y, Z, 2], action in (-1, 1) [..., 2], at full size only; what other
          heads return, their files in muvo_jax/heads say.

        Raises:
          ValueError: for a head that the model does not have, features of another shape, or states without the memory
            that their heads need.
        """
        names = self.config.heads if heads is None else tuple(heads)
        unknown = [name for name in names if name not in self.config.heads]
        if unknown:
            raise ValueError(f"decode: this model has no head {', '.join(unknown)}; "
                             f"it has {', '.join(self.config.heads)}.")
        features = states.features if isinstance(states, LatentState) else states
        shape = self.feature_shape
        lead = features.shape[:-len(shape)]
        if features.shape[len(lead):] != shape:
            raise ValueError(f"decode: got features {list(features.shape)}, expected "
                             f"[{', '.join(map(str, ('...', *shape)))}] for the {self.config.latent.kind} latent.")
        if 0 in lead:
            raise ValueError(f"decode: got features {list(features.shape)}, expected at least one state.")
        vantage = None
        if set(memory_lib.guessed_heads(self.config)).isdisjoint(names):
            memory = None
        else:
            vantage, rows = memory_lib.check(self.config, states, memory, rows, lead)
        flat = self._apply(variables, "decode", features.reshape(-1, *shape), vantage, memory, rows, names)
        finish = lambda name, scale, value: head_lib.get(name).finish(value, scale, self.config)
        return Predictions({name: {scale: finish(name, scale, value).reshape(*lead, *value.shape[1:])
                                   for scale, value in scales.items()} for name, scales in flat.items()})

    def _move(self, variables: Variables, method: str, *args) -> Any:
        """A step of the transition, by its own part of the variables."""
        own = {kind: tree["transition"] for kind, tree in variables.items() if "transition" in tree}
        return latents.TRANSITIONS[type(self.config.latent)](self.config).apply(own, *args, method=method)

    def _apply(self, variables: Variables, method: str, *args, **options) -> Any:
        return Network(self.config).apply(variables, *args, method=method, **options)

    def _frames(self, batch: Batch) -> dict[str, Any]:
        """The model's inputs with batch and time merged, [B * T, ...], after checking their sizes."""
        config = self.config
        frames = {}
        for name, shape in inputs(config).items():
            value = getattr(batch, name)
            if value is None:
                raise ValueError(f"Batch.{name} is None, but the model reads it; switch it off in the configuration of "
                                 f"the model or give it.")
            lead = ("B",) if name in UNTIMED_FIELDS else ("B", "T")
            if value.shape[len(lead):] != shape:
                raise ValueError(f"Batch.{name}: got {list(value.shape)}, expected "
                                 f"[{', '.join(map(str, (*lead, *shape)))}] as the model's configuration says.")
            if name in UNTIMED_FIELDS:
                value = jnp.broadcast_to(jnp.asarray(value)[:, None], (*batch.action.shape[:2], *shape))
            frames[name] = jnp.reshape(value, (-1, *shape))
        return frames


def inputs(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """What a model reads: name of a Batch field -> its shape for one frame."""
    fields: dict[str, tuple[int, ...]] = {}
    if config.camera is not None:
        fields |= encoders.CAMERAS[type(config.camera)].inputs(config)
    if config.lidar is not None:
        fields |= encoders.LIDARS[type(config.lidar)].inputs(config)
    if config.route:
        fields["route_map"] = ROUTE_MAP_SIZE
    if config.navigation:
        fields |= {"command": (), "next_command": (), "target_m": (2,), "next_target_m": (2,)}
    if config.speed or (config.tracks_motion and config.kinematics is not None):
        fields["speed_mps"] = ()
    return fields | memory_lib.inputs(config)


@functools.lru_cache(maxsize=8)
def _variable_shapes(config: ModelConfig) -> dict[str, Any]:
    network, moving = Network(config), latents.TRANSITIONS[type(config.latent)](config)
    frames = {name: jax.ShapeDtypeStruct((1, *shape), BATCH_FIELDS[name][0]) for name, shape in inputs(config).items()}
    state, key = moving.initial_state(config, 1), jax.random.key(0)
    noise = StepNoise(state.stochastic, state.stochastic, jnp.zeros((1,), jnp.bool_))
    action, is_first = jnp.zeros((1, 2), jnp.float32), jnp.zeros((1,), jnp.bool_)

    def fresh(frames):
        embedding, around = network.init_with_output(key, frames, state, method="everything")
        own = moving.init(key, noise, state, action, embedding, is_first, method="observe_step")
        return {kind: {**tree, **({"transition": own[kind]} if kind in own else {})} for kind, tree in around.items()}

    return jax.eval_shape(fresh, frames)
