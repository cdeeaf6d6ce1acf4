"""Recomputes the numbers of the authors' PyTorch code, entry by entry: python -m muvo_jax.interop.parity DIR."""
