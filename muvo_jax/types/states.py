"""What a model knows: latent states, where they stand, what is remembered, and what observing and imagining return."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp

from muvo_jax.types.arrays import Array, Indexable


@flax.struct.dataclass
class Gaussian(Indexable):
    """A diagonal Gaussian.

    Attributes:
      mean, std: float32 [..., S]; tokens [..., N, C] with the 2D latent.
    """

    mean: Array
    std: Array

    def sample(self, noise: Array) -> Array:
        """mean + std * noise; zeros give the mean."""
        return self.mean + self.std * noise


@flax.struct.dataclass
class Motion(Indexable):
    """The car in the ego frame of an earlier moment (x forward, y left).

    Attributes:
      pose: float32 [..., 3], x (m), y (m), yaw (rad, counter-clockwise).
      speed_mps: float32 [...].
    """

    pose: Array
    speed_mps: Array


@flax.struct.dataclass
class Vantage(Indexable):
    """Where a state stands to what was observed: how decoders know from where they look at a Memory.

    Attributes:
      motion: Motion [...], the car in the ego frame of the memory's newest observation.
      first: int32 [...], the memory's first observation that belongs to this drive.
      last: int32 [...], the newest one that this state has seen.
      steps: int32 [...], imagined since then; at 0 the state is that of the observation `last` itself, which its
        decoders must not look up: their guess comes from the observations before it.
    """

    motion: Motion
    first: Array
    last: Array
    steps: Array


@flax.struct.dataclass
class Memory(Indexable):
    """The last F observations as they came and where they were taken; held once, without axes of time or branches.

    Attributes:
      pose: float32 [B, F, 3], x, y, yaw of each in the ego frame of the newest, which is the last one.
      range_view: float32 [B, F, Hr, Wr, 4], as Batch.range_view; without lidar there is no memory.
      image: uint8 [B, F, H, W, 3], as Batch.image; None for a model without camera.
      intrinsics: float32 [B, 3, 3]; None without image.
      camera_to_ego: float32 [B, 4, 4]; None without image.
      evidence: float32 [B, X', Y', 2 Z] for voxels, worked out once for many states (glimpse.with_evidence); or None.
      onward: float32 [B, S, X', Y', Z], beside it what moves, S steps ahead (glimpse.VoxelGlimpse); or None.
    """

    pose: Array
    range_view: Array
    image: Array | None = None
    intrinsics: Array | None = None
    camera_to_ego: Array | None = None
    evidence: Array | None = None
    onward: Array | None = None


@flax.struct.dataclass
class LatentState(Indexable):
    """What the world model knows: the carry of the recurrence, for training, imagination, planning and live use.

    Attributes:
      deterministic: float32 [..., D], the recurrent state h; tokens [..., N, C] with the 2D latent.
      stochastic: float32 [..., S], the sampled state s; tokens [..., N, C] with the 2D latent.
      vantage: Vantage [...] of a model that keeps track of its motion (ModelConfig.tracks_motion), else None.
    """

    deterministic: Array
    stochastic: Array
    vantage: Vantage | None = None

    @property
    def features(self) -> Array:
        """float32 [..., D + S] ([..., N, 2 C] with the 2D latent), what decoders read: h first, as in the reference.

        Policies and rewards that want one vector for either latent take WorldModel.policy_features of it.
        """
        return jnp.concatenate([self.deterministic, self.stochastic], axis=-1)


@flax.struct.dataclass
class StepNoise(Indexable):
    """Everything random in one observed step, drawn outside so that the step itself is deterministic.

    Attributes:
      prior, posterior: standard normal, of the shape of the stochastic state; zeros give the mean mode.
      use_prior: bool [...], true where the next step starts from the prior sample (the paper's RSSM dropout).
      dropout: typed keys [...] of the dropout inside the 2D latent's transformers; None switches it off.
    """

    prior: Array
    posterior: Array
    use_prior: Array
    dropout: Array | None = None


@flax.struct.dataclass
class Observed(Indexable):
    """What `observe` returns, time on axis 1.

    An index applies to states and Gaussians; the memory, which has no time, follows it along the batch alone, so that
    the states of some frames are decoded with all that was remembered.

    Attributes:
      states: LatentState [B, T, ...], each with its posterior's sample, which is what decoders read (under the RSSM
        dropout of training, the recurrence itself may have gone on from the prior's).
      posterior, prior: Gaussian [B, T, ...].
      memory: Memory [B, ...] of the window, for a model with first_guess="last_seen"; `decode` takes it.
    """

    states: LatentState
    posterior: Gaussian
    prior: Gaussian
    memory: Memory | None = None

    def __getitem__(self, index) -> Observed:
        of_batch = index[:1] if isinstance(index, tuple) else index
        return Observed(self.states[index], self.posterior[index], self.prior[index],
                        None if self.memory is None else self.memory[of_batch])

    @property
    def last(self) -> LatentState:
        """The state after the last observed frame, where imagination starts."""
        return self.states[:, -1]


@flax.struct.dataclass
class Dream(Indexable):
    """What `imagine` returns: H imagined steps, time on the axis after those of the start states and of branches.

    Attributes:
      states: LatentState [..., H, ...]; step k is the state after action k.
      actions: float32 [..., H, 2], the actions that were applied.
      prior: Gaussian [..., H, ...] of each step.
    """

    states: LatentState
    actions: Array
    prior: Gaussian

    @property
    def features(self) -> Array:
        return self.states.features
