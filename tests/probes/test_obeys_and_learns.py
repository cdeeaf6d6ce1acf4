"""Does training teach a model to obey actions, and can it learn at all: worlds in which nothing else decides."""

import functools

import probe_worlds
import pytest

WORLDS = {"bar": probe_worlds.Bar(), "wall": probe_worlds.Wall()}
NOISE = 10.0  # grey levels


@functools.cache
def trainer(world, latent):
    return probe_worlds.Trainer(WORLDS[world], probe_worlds.config_of(WORLDS[world], latent))


@pytest.mark.parametrize("latent", ["1d", "2d"])
@pytest.mark.parametrize("world", WORLDS)
def test_what_is_imagined_obeys_the_action_and_beats_the_last_frame(world, latent):
    batches = [probe_worlds.windows(WORLDS[world], seed) for seed in range(probe_worlds.BATCHES)]
    variables = trainer(world, latent).train(lambda step: batches[step % len(batches)])
    found = probe_worlds.judge(trainer(world, latent), variables)
    assert found["gain"] > 0.9 and found["correlation"] > 0.9, found
    assert found["imagined"] < found["copied"], found
