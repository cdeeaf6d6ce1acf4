"""How exact matrix products and convolutions are, on every platform; said here and nowhere else.

Left to themselves a GPU rounds the factors of float32 products to TF32 (10 bits) and a TPU to bfloat16 (7 bits), and
say nothing. Here float32 means float32, so that a run gives the same numbers wherever it goes on, and parity with the
reference holds on an accelerator too. Who wants the speed asks for it by name: model.compute_dtype=bfloat16, for which
this changes nothing.
"""

from jax import lax

PRODUCTS = lax.Precision.HIGHEST
