"""Doors to other libraries, one adapter a file, each importing its library when it is imported itself.

    gymnax_env, brax_env, stoa_env, gymnasium_env, mctx_model: muvo_jax.agents.doors.NAME, extras of the same names
    dreamer: imagine(start, policy, length) as DreamerV3 calls it; needs nothing

All of them wrap muvo_jax.agents.environment.Environment and its EnvParams; gymnax, brax and stoa also
muvo_jax.agents.futures.SharedFutures and its params, which have the same functions.
"""
