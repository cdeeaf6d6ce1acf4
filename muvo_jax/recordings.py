"""The recording that a config names: a folder of any known kind, or the built-in town, which is recorded first."""

from __future__ import annotations

import dataclasses

from muvo_jax import config as config_lib
from muvo_jax.data import prepare, schema, sources
from muvo_jax.town import record

HELD_OUT = "val_rl"  # the town's split that is looked at first


class _OneSplit:
    """A recording as if it had no other split."""

    def __init__(self, recording: schema.Recording, split: str):
        self.description = dataclasses.replace(recording.description, splits=(split,))
        self.sequences = tuple(sequence for sequence in recording.sequences if sequence.split == split)
        self.read, self.action = recording.read, recording.action
        if isinstance(recording, schema.ReadsFields):
            self.read_fields = recording.read_fields


def check_town(data: config_lib.DataConfig) -> None:
    """Raises DataError where the town is asked for what only other recordings have."""
    if data.camera:
        raise schema.DataError(f"the built-in town has no camera {data.camera!r}; it has one only. Leave --data-camera "
                               f"out, or give the recording with --data=PATH.")
    if data.key_frames:
        raise schema.DataError("the built-in town has no key frames; leave --key-frames out, or give the recording "
                               "with --data=PATH.")


def open_configured(config: config_lib.Config, progress: record.Progress | None = None, *,
                    split: str | None = None) -> schema.Recording:
    """Opens the recording that a config names; the built-in town is recorded first where it is not in the cache.

    Args:
      progress: called with (frames done, frames in all) while the town is recorded.
      split: the only one of the town that will be read; it is then the only one that the recording has.

    Raises:
      DataError: as sources.open_recording.
      ValueError: for a split that the town does not have.
    """
    labels = prepare.labels(config)
    if config.data.path == "town":
        town = sources.open_recording(record.cached_town(config, progress, split=split), labels=labels)
        return town if split is None else _OneSplit(town, split)
    return sources.open_recording(config.data.path, camera=config.data.camera, key_frames=config.data.key_frames,
                                  labels=labels, skip_corrupt_shards=config.data.skip_corrupt_shards)
