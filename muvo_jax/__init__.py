"""MUVO, a multimodal generative world model for driving, in JAX."""
