"""The recording that a config names: a folder of any known kind, or the built-in town, which is recorded first."""

from __future__ import annotations

from muvo_jax import config as config_lib
from muvo_jax.data import prepare, schema, sources
from muvo_jax.town import record


def open_configured(config: config_lib.Config, progress: record.Progress | None = None) -> schema.Recording:
    """Opens the recording that a config names; the built-in town is recorded first where it is not in the cache.

    Args:
      progress: called with (frames done, frames in all) while the town is recorded.

    Raises:
      DataError: as sources.open_recording.
    """
    labels = prepare.labels(config)
    if config.data.path == "town":
        return sources.open_recording(record.cached_town(config, progress), labels=labels)
    return sources.open_recording(config.data.path, camera=config.data.camera, key_frames=config.data.key_frames,
                                  labels=labels, skip_corrupt_shards=config.data.skip_corrupt_shards)
