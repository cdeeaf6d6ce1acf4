"""Windows, batches, resuming, the frame cache and the way to the devices."""

import collections
import dataclasses
import itertools
import threading

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax import config as config_lib
from muvo_jax import presets
from muvo_jax.data import fitting, pipeline, schema, windows

CAMERA = schema.Camera(64, 32, ((32, 0, 32), (0, 32, 16), (0, 0, 1)), tuple(map(tuple, np.eye(4).tolist())))


class MemoryRecording:
    """Frames made of their own number: frame k of a sequence has speed and image value start + k."""

    def __init__(self, sequences):
        self.sequences = tuple(sequences)
        self.description = schema.RecordingDescription(
            name="memory", kind="memory", rate_hz=10.0, camera=CAMERA, lidar=config_lib.RangeViewGeometry(),
            voxels=None, contract=config_lib.ActionContract(), splits=("train", "val"),
            modalities=frozenset(("image", "points_m", "action", "speed_mps")))
        self.reads = collections.Counter()

    def read(self, sequence, index):
        assert 0 <= index < sequence.length
        number = sequence.start + index
        self.reads[sequence.name, number] += 1
        if number == 13:
            raise schema.DataError("image/000013.png: not a readable image")
        return {"image": np.full((32, 64, 3), number, np.uint8), "intrinsics": np.eye(3, dtype=np.float32),
                "camera_to_ego": np.eye(4, dtype=np.float32), "points_m": np.full((2, 3), 3.0, np.float32),
                "speed_mps": np.float32(number), "action": self.action(sequence, index),
                "timestamp_s": np.float64(number / 10), "frame_id": np.int64(number)}

    def action(self, sequence, index):
        return np.array([(sequence.start + index) / 32, -0.125], np.float32)


def frames_of(*sequences, **data):
    recording = MemoryRecording(sequences or (schema.Sequence("train", "a", 0, 12), schema.Sequence("val", "b", 20, 9)))
    preset = presets.get("tiny")
    preset = dataclasses.replace(preset, data=dataclasses.replace(preset.data, **data),
                                 model=dataclasses.replace(preset.model, heads=("image", "range_view", "action")))
    return pipeline.Frames(recording, fitting.adapt(preset, recording).config)


def take(iterator, count):
    return list(itertools.islice(iterator, count))


def speeds(batches):
    return [np.asarray(batch.speed_mps).tolist() for batch in batches]


def test_a_batch_is_valid_and_lacks_what_the_recording_lacks():
    frames = frames_of()
    batch = next(pipeline.train_batches(frames, seed=0)).validate()
    assert batch.image.shape == (2, 4, 32, 64, 3) and batch.range_view.shape == (2, 4, 32, 64, 4)
    assert batch.intrinsics.shape == (2, 3, 3) and batch.camera_to_ego.shape == (2, 4, 4)
    assert batch.occupancy is None and batch.route_map is None and batch.reward is None
    np.testing.assert_array_equal(batch.is_first, [[True, False, False, False]] * 2)
    np.testing.assert_array_equal(batch.image[:, :, 0, 0, 0], batch.speed_mps)
    np.testing.assert_array_equal(np.diff(batch.speed_mps, axis=1), 2)  # the stride


def test_the_action_of_a_step_is_the_mean_of_what_was_applied_over_it():
    window = lambda frames, start: windows.Window(frames.recording.sequences[0], start, 4, 3)
    frames = frames_of(frames=4, stride=3)  # action k is k / 32
    assert frames.config.contract.step_action == "mean"
    actions = frames.batch([window(frames, 0), window(frames, 2)]).action
    np.testing.assert_array_equal(actions[0, :, 0] * 32, [(0 + 1 + 2) / 3, (3 + 4 + 5) / 3, (6 + 7 + 8) / 3, 10])
    # The sequence ends with frame 11, where the last step of this window begins.
    np.testing.assert_array_equal(actions[1, :, 0] * 32, [3, 6, 9, 11])
    np.testing.assert_array_equal(actions[..., 1], -0.125)


def test_the_first_action_stands_for_a_step_where_the_contract_says_so_and_every_one_at_stride_1():
    frames = frames_of(frames=4, stride=3)
    config = frames.config
    frames = pipeline.Frames(frames.recording, dataclasses.replace(
        config, contract=dataclasses.replace(config.contract, step_action="first")))
    sequence = frames.recording.sequences[0]
    np.testing.assert_array_equal(frames.batch([windows.Window(sequence, 1, 4, 3)]).action[0, :, 0] * 32, [1, 4, 7, 10])
    both = [frames_of(frames=4, stride=1), frames]
    one, other = (made.batch([windows.Window(sequence, 5, 4, 1)]).action for made in both)
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("stride", [1, 3])
def test_actions_that_lie_a_rounding_beyond_are_applied_in_full(stride, monkeypatch):
    """Readers let 1.0005 pass; imagination under the recorded actions of a batch takes [-1, 1]."""
    monkeypatch.setattr(MemoryRecording, "action", lambda *_: np.array([1.0005, -1.0005], np.float32))
    frames = frames_of(frames=4, stride=stride)
    batch = frames.batch([windows.Window(frames.recording.sequences[0], 1, 4, stride)])
    np.testing.assert_array_equal(batch.action, np.broadcast_to(np.float32([1.0, -1.0]), (1, 4, 2)))


def test_adapting_to_a_recording_keeps_what_the_run_says_of_steps():
    frames = frames_of()
    config = dataclasses.replace(frames.config, contract=config_lib.ActionContract(step_action="first"))
    assert fitting.adapt(config, frames.recording).config.contract.step_action == "first"


@settings(max_examples=50, deadline=None)
@given(lengths=st.lists(st.integers(1, 15), min_size=1, max_size=4), frames=st.integers(1, 6), stride=st.integers(1, 3))
def test_windows_stay_inside_their_sequence_and_none_is_left_out(lengths, frames, stride):
    starts = itertools.accumulate([0, *lengths[:-1]], lambda start, length: start + length + 1)
    sequences = [schema.Sequence("train", "run", start, length) for start, length in zip(starts, lengths, strict=True)]
    recording = MemoryRecording(sequences)
    expected = sum(max(0, length - (frames - 1) * stride) for length in lengths)
    if not expected:
        with pytest.raises(schema.DataError, match=f"has {max(lengths)} frames, but a window of {frames} frames"):
            windows.find_windows(recording, "train", frames=frames, stride=stride)
        return
    found = windows.find_windows(recording, "train", frames=frames, stride=stride)
    assert len(found) == len(set(found)) == expected
    for window in found:
        assert len(window.indices) == frames
        assert window.indices[0] >= 0 and window.indices[-1] < window.sequence.length
        assert set(np.diff(window.indices)) <= {stride}


def test_an_unknown_split_is_named():
    with pytest.raises(schema.DataError, match="no split 'test'; it has train, val"):
        windows.find_windows(frames_of().recording, "test", frames=2, stride=1)


def test_an_epoch_is_every_window_once_and_epochs_differ():
    stream = pipeline.train_batches(frames_of(), seed=0)
    assert stream.windows_per_epoch == 6  # 12 frames, windows of 4 at stride 2 span 7
    first, second = ([row[0] for batch in speeds(take(stream, 3)) for row in batch] for _ in range(2))
    assert sorted(first) == sorted(second) == [0, 1, 2, 3, 4, 5]
    assert first != second


def test_batches_of_one_window_come_for_ever():
    stream = pipeline.train_batches(frames_of(), seed=0, batch=1)
    assert all(batch.batch_size == 1 for batch in take(stream, 2 * stream.windows_per_epoch + 1))


def test_processes_share_each_batch_and_any_number_of_them_resumes():
    """Two processes read the halves of what one reads, and go on from its saved position."""
    one = pipeline.train_batches(frames_of(), seed=0)
    whole = speeds(take(one, 5))
    halves = [pipeline.TrainBatches(frames_of(), seed=0, process=process, processes=2) for process in range(2)]
    read = [speeds(take(half, 5)) for half in halves]
    assert [left + right for left, right in zip(*read, strict=True)] == whole
    assert halves[0].get_state()["identity"] == one.get_state()["identity"]
    resumed = [pipeline.TrainBatches(frames_of(), seed=0, process=process, processes=2, start_state=one.get_state())
               for process in range(2)]
    left, right = (speeds(take(half, 1)) for half in resumed)
    assert left[0] + right[0] == speeds(take(one, 1))[0]
    with pytest.raises(schema.DataError, match="process 0 of 3: a batch of 2"):
        pipeline.TrainBatches(frames_of(), seed=0, process=0, processes=3)


def test_the_number_of_workers_changes_nothing():
    streams = [pipeline.train_batches(frames_of(workers=workers), seed=0) for workers in (1, 5)]
    first, second = (speeds(take(stream, 6)) for stream in streams)
    assert first == second and 2 <= pipeline.default_workers() <= 16


def test_the_seed_decides_the_order():
    orders = [speeds(take(pipeline.train_batches(frames_of(), seed=seed), 6)) for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]


@pytest.mark.parametrize("done", [0, 1, 4])
def test_resuming_gives_exactly_the_batches_that_would_have_come(done):
    stream = pipeline.train_batches(frames_of(), seed=3)
    take(stream, done)
    state = stream.get_state()
    expected = speeds(take(stream, 5))
    assert speeds(take(pipeline.train_batches(frames_of(), seed=3, start_state=state), 5)) == expected


def test_a_position_in_other_data_is_refused():
    state = pipeline.train_batches(frames_of(), seed=3).get_state()
    with pytest.raises(schema.DataError, match=r"'seed': 3.*this run has .*'seed': 4"):
        pipeline.train_batches(frames_of(), seed=4, start_state=state)


def test_a_damaged_file_is_named_in_the_main_thread():
    frames = frames_of(schema.Sequence("train", "a", 10, 12), schema.Sequence("val", "b", 30, 9))
    stream = pipeline.train_batches(frames, seed=0)
    with pytest.raises(schema.DataError, match=r"000013\.png"):
        take(stream, 6)


def test_evaluation_windows_are_spread_evenly_padded_and_counted():
    frames = frames_of()  # val: 9 frames from 20, windows of 4 at stride 2 start at 20, 21, 22
    batches = list(pipeline.evaluation_batches(frames, "val", windows=0))
    assert [batch.count for batch in batches] == [2, 1]
    assert {batch.batch.action.shape for batch in batches} == {(2, 4, 2)}
    np.testing.assert_array_equal(batches[1].batch.speed_mps, [[22, 24, 26, 28]] * 2)
    assert [window.start for batch in batches for window in batch.windows] == [0, 1, 2]
    picked = list(pipeline.evaluation_batches(frames, "train", windows=3, length=2, batch=3))
    assert [window.start for window in picked[0].windows] == [0, 4, 9]  # of 10
    assert picked[0].batch.frames == 2


def test_beside_every_window_stands_one_of_another_drive():
    sequences = [schema.Sequence("val", name, start, 9) for name, start in (("b", 30), ("c", 50))]
    frames = frames_of(schema.Sequence("train", "a", 10, 12), *sequences)
    entries = list(pipeline.evaluation_batches(frames, "val", windows=0, batch=4))
    for entry in entries:
        real = zip(entry.windows, entry.others, strict=False)
        assert all(own.sequence.name != other.sequence.name for own, other in real)
        assert frames.actions(entry.others).shape == entry.batch.action.shape
    alone = pipeline.windows_lib.others(entries[0].windows[:2])
    assert alone == entries[0].windows[1::-1]  # of one drive only: another window of it
    assert next(pipeline.evaluation_batches(frames, "val", windows=1, batch=4)).others == ()


def test_evaluation_of_a_missing_split_fails_at_the_call():
    with pytest.raises(schema.DataError, match="no split 'val_ds'"):
        pipeline.evaluation_batches(frames_of(), "val_ds", windows=1)


def test_the_cache_is_used_and_bounded():
    frames = frames_of(cache_gib=1.0)
    take(pipeline.train_batches(frames, seed=0), 9)
    assert set(frames.recording.reads) == {("a", number) for number in range(12)}
    assert sum(frames.recording.reads.values()) < 30  # without a cache 9 * 2 * 4, twice two threads may race
    one_frame = 32 * 64 * 3 + 32 * 64 * 4 * 4
    bounded = frames_of(cache_gib=5.5 * one_frame / 2**30)
    take(pipeline.train_batches(bounded, seed=0), 9)
    assert one_frame < bounded.cache.bytes_used < 5.5 * one_frame


def test_the_cache_drops_the_least_recently_used():
    cache = windows.FrameCache(limit_bytes=2 * 8)
    made = []

    def get(key):
        return cache.get(key, lambda: made.append(key) or {"value": np.float64(key)})["value"]

    assert [get(key) for key in (1, 2, 1, 3, 1, 2)] == [1, 2, 1, 3, 1, 2]
    assert made == [1, 2, 3, 2]
    assert cache.bytes_used == 16
    cache.get("large", lambda: {"value": np.zeros(100)})
    assert cache.bytes_used == 16


def test_the_cache_under_several_threads():
    cache = windows.FrameCache(limit_bytes=10 * 8)

    def work(seed):
        for key in np.random.default_rng(seed).integers(0, 30, 500).tolist():
            assert cache.get(key, lambda key=key: {"value": np.float64(key)})["value"] == key

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cache.bytes_used == 80


def test_prefetch_hands_over_device_arrays_in_order_with_their_state():
    expected = speeds(take(pipeline.train_batches(frames_of(), seed=1), 4))
    with pipeline.prefetch_to_device(pipeline.train_batches(frames_of(), seed=1)) as prefetch:
        batches = take(prefetch, 2)
        state = prefetch.get_state()
        assert prefetch.waited_s > 0
    assert all(isinstance(batch.image, jax.Array) for batch in batches)
    assert speeds(batches) == expected[:2]
    with pytest.raises(StopIteration):
        next(prefetch)
    # The state is that of the batches handed out, although more were read ahead.
    assert speeds(take(pipeline.train_batches(frames_of(), seed=1, start_state=state), 2)) == expected[2:]


def test_prefetch_shards_over_devices():
    mesh = jax.make_mesh((2,), ("data",), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:2])
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("data"))
    with pipeline.prefetch_to_device(pipeline.train_batches(frames_of(), seed=1), sharding) as prefetch:
        assert next(prefetch).image.sharding.is_equivalent_to(sharding, 5)


def test_prefetch_raises_the_error_of_its_thread_after_the_good_batches():
    def broken():
        yield np.zeros(1)
        raise schema.DataError("image/000001.png: not a readable image")

    prefetch = pipeline.prefetch_to_device(broken())
    np.testing.assert_array_equal(next(prefetch), [0])
    with pytest.raises(schema.DataError, match=r"000001\.png"):
        next(prefetch)
    with pytest.raises(StopIteration):
        next(prefetch)


def test_prefetch_ends_with_its_iterator_and_reads_no_further_than_its_size():
    assert len(list(pipeline.prefetch_to_device(iter(np.zeros((5, 1)))))) == 5
    read = []
    prefetch = pipeline.prefetch_to_device((read.append(number) or np.zeros(1) for number in itertools.count()), size=2)
    next(prefetch)
    prefetch.close()
    assert len(read) <= 6  # one handed out, two in the queue, one in the thread's hand, slack while closing


def test_motion_since_the_frame_before_is_made_of_poses():
    """At a stride of 2 the car has driven 2 m between frames, whatever the heading."""
    recording = MemoryRecording([schema.Sequence("train", "a", 14, 16), schema.Sequence("val", "b", 40, 16)])
    recording.description = dataclasses.replace(recording.description,
                                                modalities=recording.description.modalities | {"pose"})
    read, north = recording.read, np.pi / 2
    recording.read = lambda sequence, index: read(sequence, index) | {
        "pose": np.array([3.0, float(sequence.start + index), north])}
    preset = presets.get("tiny")
    model = dataclasses.replace(preset.model, heads=("action", "ego_motion"), speed=False)
    config = dataclasses.replace(preset, model=model, data=dataclasses.replace(preset.data, frames=3, stride=2))
    fitting.check_targets(config, recording.description)
    frames = pipeline.Frames(recording, fitting.adapt(config, recording).config)
    motion = next(pipeline.train_batches(frames, seed=0, batch=1)).ego_motion
    np.testing.assert_allclose(motion[0, 1:, :3], [[2, 0, 0], [2, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(np.diff(motion[0, :, 3]), [2, 2])  # the speed of frame k is k
    blind = dataclasses.replace(recording.description, modalities=frozenset({"speed_mps"}))
    with pytest.raises(schema.DataError, match=r"head 'ego_motion' learns from pose.* \(--heads=action\)"):
        fitting.check_targets(config, blind)


@given(st.lists(st.integers(0, 3), min_size=2, max_size=12))
def test_the_other_window_is_the_first_of_another_drive_from_half_the_list_on(drives):
    found = tuple(windows.Window(schema.Sequence("train", f"train/{drive}", index, 5), 0, 2, 1)
                  for index, drive in enumerate(drives))
    count = len(found)
    for index, other in enumerate(windows.others(found)):
        places = [(index + count // 2 + step) % count for step in range(count)]
        expected = next((place for place in places if drives[place] != drives[index]), places[0])
        assert other is found[expected]
