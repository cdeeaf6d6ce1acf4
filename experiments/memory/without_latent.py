"""What the memory's decoders learn without the latent: trains as `muvo_jax.train` does, all decoders see zeros for it.

    python -m experiments.memory.without_latent --fusion=tr --name=without-latent

takes the flags of muvo_jax.train. The other rows of docs/memory.md are made by that command itself: the latent alone by
`--set model.first_guess=training_mean --steps=460`, both by the default.
"""

import sys

import jax.numpy as jnp

from muvo_jax import train
from muvo_jax.model import world_model

if __name__ == "__main__":
    read = world_model.Network.read
    world_model.Network.read = lambda self, features, head: jnp.zeros_like(read(self, features, head))
    sys.exit(train.main())
