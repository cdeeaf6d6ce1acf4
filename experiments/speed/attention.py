"""Compares attention (muvo_jax.nn.attention) with jax.nn.dot_product_attention: python experiments/speed/attention.py

Both take turns; processor milliseconds, the least of ROUNDS, forward alone and with the gradients of all three inputs.
"""

import functools

import jax
import jax.numpy as jnp
import timing

from muvo_jax.nn import attention

ROUNDS = 5
SIZES = {"paper, prior on itself": (1, 1093, 1093, 8, 48), "paper, posterior on what it reads": (1, 1093, 1612, 8, 48),
         "paper, fusion of 6 frames": (6, 516, 516, 8, 48), "town, filter": (8, 85, 86, 4, 24),
         "town, fusion of 12 frames": (96, 48, 48, 4, 24), "town, 256 states": (256, 85, 86, 4, 24)}


def ours(query: jax.Array, key: jax.Array, value: jax.Array) -> jax.Array:
    """[N, L, H, c] of [N, L, H, c] and twice [N, M, H, c], as what it is compared with."""
    heads_first = (jnp.swapaxes(part, 1, 2) for part in (query, key, value))
    return jnp.swapaxes(attention._attend(0.0, *heads_first, None), 1, 2)


def gradients(form):
    return jax.jit(jax.grad(lambda *given: (form(*given) ** 2).sum(), (0, 1, 2)))


def main() -> None:
    forms = {"ours": ours, "jax.nn": functools.partial(jax.nn.dot_product_attention, implementation="xla")}
    print("| what | forward: ours | jax.nn | times | with gradients: ours | jax.nn | times |\n"
          "|---|---:|---:|---:|---:|---:|---:|")
    for name, (count, length, memory, heads, channels) in SIZES.items():
        given = tuple(jax.random.normal(jax.random.key(seed), (count, tokens, heads, channels))
                      for seed, tokens in enumerate((length, memory, memory)))
        cells = []
        for measure in (jax.jit, gradients):
            taken = timing.processor_seconds({form: functools.partial(measure(function), *given)
                                              for form, function in forms.items()}, ROUNDS)
            milliseconds = [1e3 * taken[form].min() for form in forms]
            cells += [f"{value:.1f}" for value in milliseconds] + [f"{milliseconds[1] / milliseconds[0]:.1f}"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
