"""The gradient through a dream to its actions: python examples/gradient.py runs/town-tr

Which actions lead from one observed moment to another? Gradient descent on the distance between the imagined latents
and those that were observed later; the recording says what the driver did. (A posterior remembers the action that led
to it, so on a trained model this finds them: correlations near 1.)
"""

import sys

import jax
import jax.numpy as jnp
import optax

import muvo_jax


def main(folder: str = "builtin:town") -> None:
    run = muvo_jax.load(folder)
    model, variables = run.model, run.variables
    batch = muvo_jax.windows(run, "train", count=8)
    observed = muvo_jax.observe(model, variables, jax.random.key(0), batch, sampled=False)
    now = batch.frames // 2 - 1
    start, wanted = observed.states[:, now], model.policy_features(observed.states.features[:, now + 1:])
    driven = jnp.asarray(batch.action)[:, now:-1]  # [8 windows, steps, 2]: what the driver did

    @jax.jit
    @jax.value_and_grad
    def distance(actions):
        dream = muvo_jax.imagine(model, variables, jax.random.key(1), start, jnp.tanh(actions), sampled=False)
        return ((model.policy_features(dream.features) - wanted) ** 2).mean()

    actions, optimizer = jnp.zeros_like(driven), optax.adam(0.05)
    state = optimizer.init(actions)
    for step in range(40):
        loss, gradient = distance(actions)
        change, state = optimizer.update(gradient, state)
        actions = optax.apply_updates(actions, change)
        if step % 10 == 0:
            print(f"step {step}: distance {loss:.5f}, largest gradient {jnp.abs(gradient).max():.2e}")
    for name, index in (("acceleration", 0), ("steering", 1)):
        found = jnp.corrcoef(jnp.tanh(actions)[..., index].ravel(), driven[..., index].ravel())[0, 1]
        print(f"{name}: correlation of what was found with what was driven {found:.2f}")
    print(f"distance under the driven actions {distance(jnp.arctanh(0.999 * driven))[0]:.5f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
