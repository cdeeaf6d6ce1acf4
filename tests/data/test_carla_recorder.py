"""The CARLA recorder up to the client's border: byte layouts as the client's, drives of a fake server, failures."""

import importlib.util
import json
import math
import os
import pathlib
import queue
import sys
import types

import numpy as np
import pytest

from muvo_jax import command_line, record_carla
from muvo_jax.data import pictures, processes, voxelizing
from muvo_jax.data.carla import client as carla_client
from muvo_jax.data.carla import drives as carla_drives
from muvo_jax.data.carla import frames as carla_frames
from muvo_jax.data.carla import recorder as carla_recorder
from muvo_jax.data.muvo import files as muvo_files
from muvo_jax.data.plain import reader as plain_reader
from muvo_jax.data.plain import writer as plain_writer

SETTINGS = carla_drives.Settings(width_px=24, height_px=16, points_per_frame=50)
JOB = carla_drives.CarlaDrive("train", "Town01_000", "Town01", "ClearNoon", 3, 14)
needs_carla = pytest.mark.skipif(importlib.util.find_spec("carla") is None, reason="carla is not installed")
DETECTION = np.dtype("<f4, <f4, <f4, <f4, <u4, <u4")  # x, y, z, cosine, object, tag: 24 bytes


def vector(x=0.0, y=0.0, z=0.0):
    return types.SimpleNamespace(x=x, y=y, z=z)


def transform(x, y, yaw_deg, pitch_deg=0.0):
    return types.SimpleNamespace(location=vector(x, y), rotation=types.SimpleNamespace(yaw=yaw_deg, pitch=pitch_deg))


def camera(frame, pixels):
    return types.SimpleNamespace(frame=frame, width=pixels.shape[1], height=pixels.shape[0],
                                 raw_data=memoryview(pixels.tobytes()))


def scan(frame, rows):
    return types.SimpleNamespace(frame=frame, raw_data=memoryview(np.array(rows, DETECTION).tobytes()))


class FakeSimulator:
    """Drives 5 m/s straight on along CARLA's y axis (to the right of x); `spoil` may change what a tick gives."""

    def __init__(self, spoil=lambda seen: seen, speed_mps=5.0):
        self.spoil, self.speed_mps, self.started, self.running = spoil, speed_mps, [], False

    def start(self, job):
        self.started.append(job)
        self.running, self.tick = True, 100
        return self.observe()

    def step(self):
        self.tick += 1
        return self.observe()

    def stop(self):
        self.running = False

    def route_m(self):
        return np.array([(0.0, -2.0 * index) for index in range(60)])

    def observe(self):
        rng, index = np.random.default_rng(self.tick), self.tick - 100
        pictures = {name: camera(self.tick, rng.integers(0, 20, (16, 24, 4), np.uint8))
                    for name in carla_frames.CAMERAS}
        rows = [(10 + index, 4, -2, 0.5, 7, 24), (0, 0, -1, 0.5, 1, 14), (20, -3, 1, 0.5, 9, 14)]
        control = types.SimpleNamespace(throttle=0.0 if index % 2 else 0.5, steer=0.01 * index, brake=0.25)
        return self.spoil(carla_frames.Tick(
            self.tick, self.tick * 0.1, transform(0.0, 0.1 * self.speed_mps * index, 90.0), vector(y=self.speed_mps),
            control, {**pictures, "lidar": scan(self.tick, rows)}))


def test_a_drive_is_a_plain_recording_in_the_ego_frame(tmp_path):
    simulator = FakeSimulator()
    carla_recorder.record(tmp_path, simulator, [JOB], SETTINGS)
    assert not simulator.running
    recording = plain_reader.PlainRecording(tmp_path)
    assert recording.sequences[0].length == JOB.frames
    frame = recording.read(recording.sequences[0], 3)
    # y right becomes y left, the mount is added, and what hit the own car is gone.
    np.testing.assert_allclose(frame["points_m"], [[14, -4, 0], [21, 3, 3]], atol=1e-6)
    with np.load(tmp_path / "train/Town01_000/lidar/000003.npz") as arrays:
        assert arrays["point_tags"].tolist() == [muvo_files.ROAD_LINE, muvo_files.VEHICLE]
    np.testing.assert_allclose(frame["action"], [0.5, 0.04])  # of the tick after: it led there
    assert frame["speed_mps"] == 5 and frame["yaw_rate_radps"] == 0
    pixels = np.frombuffer(FakeSimulator.observe(types.SimpleNamespace(
        tick=103, spoil=lambda seen: seen, speed_mps=5.0)).measurements["image"].raw_data, np.uint8).reshape(16, 24, 4)
    np.testing.assert_array_equal(frame["image"], pixels[..., [2, 1, 0]])
    assert (frame["route_map"][:50, 32] == 255).all() and not frame["route_map"][:, [20, 44]].any()
    assert recording.description.camera.intrinsics[0][0] == pytest.approx(12 / math.tan(math.radians(55)), rel=1e-6)


def test_a_collision_is_the_end_of_a_sequence_and_costs(tmp_path):
    carla_recorder.record(tmp_path, FakeSimulator(lambda seen: seen._replace(collided=seen.frame == 104)), [JOB],
                          SETTINGS)
    recording = plain_reader.PlainRecording(tmp_path)
    assert [sequence.length for sequence in recording.sequences] == [5, 9]
    frames = [recording.read(recording.sequences[0], index) for index in (3, 4)]
    assert [(frame["reward"], bool(frame["is_terminal"])) for frame in frames] == [(1.0, False), (-1.0, True)]
    route = carla_frames.Route(np.array([(0.0, 0.0), (2.0, 0.0), (4.0, 0.0)]))
    assert route.deviation((1.0, -0.5, math.pi / 3)) == pytest.approx((0.5, math.pi / 3))
    assert carla_recorder.reward(False, 0.5, math.pi / 3) == pytest.approx(0.75 * 0.5)
    assert carla_recorder.reward(False, 3.0, 0.0) == carla_recorder.reward(False, 0.0, 3.0) == 0.0
    events = queue.Queue()
    events.put("hit")
    assert [carla_client.drained(events) for _ in range(2)] == [True, False]


def test_all_of_a_recording_goes_where_the_user_is_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    carla_recorder.record(pathlib.Path("~/recording"), FakeSimulator(), [JOB._replace(frames=2)], SETTINGS)
    assert plain_reader.PlainRecording(tmp_path / "home/recording").sequences[0].length == 2
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


def test_a_recording_can_be_voxelized_and_until_then_has_no_occupancy(tmp_path):
    carla_recorder.record(tmp_path, FakeSimulator(), [JOB._replace(frames=2)], SETTINGS)
    described = plain_reader.PlainRecording(tmp_path).description
    assert described.voxels is None and "occupancy" not in described.modalities
    assert voxelizing.voxelize(tmp_path, workers=1).made == 2
    recording = plain_reader.PlainRecording(tmp_path)
    frame = recording.read(recording.sequences[0], 0)
    assert frame["occupancy"].shape == recording.description.voxels.shape == (192, 192, 64)
    hit = frame["occupancy"][tuple(np.floor((frame["points_m"] - [-48, -48, -6]) / 0.5).astype(int).T)]
    assert hit.all()


def test_a_second_recorder_of_a_folder_is_told(tmp_path):
    with (processes.locked(tmp_path / ".recording", "recording"),
          pytest.raises(BlockingIOError, match="another process is recording here")):
        carla_recorder.record(tmp_path, FakeSimulator(), [JOB], SETTINGS)


def test_depth_and_tags_come_from_the_clients_channels():
    depth = np.zeros((16, 24, 4), np.uint8)
    depth[0, 0, :3] = 0, 0, 1  # blue, green, red: the least significant byte is red
    depth[0, 1, :3] = 255
    depth[0, 2, :3] = 16, 0, 0
    tags = np.zeros((16, 24, 4), np.uint8)
    tags[..., 2], tags[0, 0, 2] = 1, 11
    seen = FakeSimulator(lambda seen: seen._replace(measurements={
        **seen.measurements, "depth": camera(100, depth), "classes": camera(100, tags)})).start(JOB)
    frame = carla_frames.decode(seen, SETTINGS)
    np.testing.assert_allclose(frame["depth_m"][0, :3], np.array([1, 2 ** 24 - 1, 2 ** 20]) * 1000 / (2 ** 24 - 1))
    assert plain_writer.encode_depth(frame["depth_m"])[0, 1] == pictures.DEPTH_SKY
    assert frame["classes"][0, :2].tolist() == [muvo_files.SKY, 7]


def test_route_bends_to_the_left_in_the_picture_where_it_bends_to_the_left():
    corner = [(2.0 * index, 0.0) for index in range(6)] + [(10.0, 2.0 * index) for index in range(1, 20)]
    route = carla_frames.Route(np.array(corner))
    assert route.advance((0.5, 1.0, 0.0)) == pytest.approx(math.hypot(0.5, 1))
    picture = route.draw((0.0, 0.0, 0.0))
    row = round((160 - 10 * 5) / 3)
    assert picture.shape == (64, 64) and picture[row, :32].all() and not picture[row, 36:].any()
    turned = route.draw((0.0, 0.0, math.pi / 2))  # the car looks left: the way starts to its right
    assert turned[53, 34:].any() and not turned[53, :28].any()


def test_complete_runs_stay_and_interrupted_ones_are_recorded_again(tmp_path):
    jobs = [JOB, JOB._replace(run="Town01_001")]

    def stop_late(seen):
        if len(breaking.started) == 2 and seen.frame == 105:
            raise KeyboardInterrupt
        return seen

    breaking = FakeSimulator(stop_late)
    with pytest.raises(KeyboardInterrupt):
        carla_recorder.record(tmp_path, breaking, jobs, SETTINGS)
    assert not breaking.running
    before = (tmp_path / "train/Town01_000/frames.csv").stat().st_mtime_ns
    told, again = [], FakeSimulator()
    needed = carla_drives.estimate(tmp_path, jobs, SETTINGS)
    assert needed.measured and (needed.frames, needed.missing) == (28, 14) and needed.disk_bytes > 0
    carla_recorder.record(tmp_path, again, jobs, SETTINGS, progress=lambda done, total: told.append((done, total)))
    assert [job.run for job in again.started] == ["Town01_001"] and told[0] == (15, 28) and told[-1] == (28, 28)
    assert (tmp_path / "train/Town01_000/frames.csv").stat().st_mtime_ns == before


def blank(seen):
    black = camera(seen.frame, np.zeros((16, 24, 4), np.uint8))
    return seen._replace(measurements={**seen.measurements, "image": black})


def frozen(seen):
    first = FakeSimulator().start(JOB).measurements["depth"]
    return seen._replace(measurements={**seen.measurements, "depth": first})


@pytest.mark.parametrize("spoil, message", [
    (blank, "nothing to see in image"),
    (lambda seen: seen._replace(measurements={**seen.measurements, "lidar": scan(seen.frame, [])}), "to see in lidar"),
    (frozen, "frame 10: sensor depth has sent the same bytes 11 times"),
    (lambda seen: seen._replace(frame=2 * seen.frame), "2 ticks"),
    (lambda seen: seen._replace(timestamp_s=seen.frame * 0.05), "0.0500 s to the next frame"),
    (lambda seen: seen._replace(measurements={**seen.measurements, "classes": camera(0, np.ones((8, 8, 4), np.uint8))}),
     "sensor classes: 8x8 pixels"),
])
def test_sick_sensors_stop_the_recording_and_leave_the_run_incomplete(tmp_path, spoil, message):
    simulator = FakeSimulator(spoil)
    with pytest.raises(carla_drives.CarlaError, match=message):
        carla_recorder.record(tmp_path, simulator, [JOB], SETTINGS)
    assert not simulator.running and len(simulator.started) == 1
    assert not plain_writer.is_complete(tmp_path, JOB.split, JOB.run)


def test_a_bad_drive_is_tried_again_with_other_seeds(tmp_path, monkeypatch):
    monkeypatch.setattr(carla_recorder, "BLOCKED_S", 0.5)
    still = FakeSimulator(speed_mps=0.0)
    with pytest.raises(carla_drives.BadDriveError, match=r"has not moved for 0\.5 s"):
        carla_recorder.record(tmp_path, still, [JOB], SETTINGS)
    assert [job.seed for job in still.started] == [3, 4, 5]
    lost = FakeSimulator(lambda seen: seen._replace(transform=transform(30, 0, 90)))
    with pytest.raises(carla_drives.BadDriveError, match=r"30\.0 m off its route"):
        carla_recorder.record(tmp_path, lost, [JOB], SETTINGS)


def test_a_run_that_writes_nothing_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(plain_writer.RunWriter, "write", lambda self, frame: None)
    with pytest.raises(carla_drives.CarlaError, match=r"image: 0 files for 14 frames"):
        carla_recorder.record(tmp_path, FakeSimulator(), [JOB], SETTINGS)
    assert not plain_writer.is_complete(tmp_path, JOB.split, JOB.run)


def test_a_disk_that_is_too_small_is_told_after_the_first_run(tmp_path, monkeypatch):
    monkeypatch.setattr(carla_recorder.shutil, "disk_usage", lambda path: types.SimpleNamespace(free=1000))
    jobs, simulator = [JOB, JOB._replace(run="Town01_001")], FakeSimulator()
    with pytest.raises(carla_drives.CarlaError, match=r"GB are needed, 0\.0 GB are free"):
        carla_recorder.record(tmp_path, simulator, jobs, SETTINGS)
    assert len(simulator.started) == 1 and plain_writer.is_complete(tmp_path, JOB.split, JOB.run)


def test_collect_awaits_the_frame_of_every_sensor():
    queues = {"image": queue.Queue(), "lidar": queue.Queue()}
    for frame in (6, 7):
        queues["image"].put(types.SimpleNamespace(frame=frame))
    queues["lidar"].put(types.SimpleNamespace(frame=7))
    found = carla_frames.collect(queues, 7, 0.01)
    assert {name: seen.frame for name, seen in found.items()} == {"image": 7, "lidar": 7}
    with pytest.raises(carla_drives.CarlaError, match=r"sensor image stalled: nothing for frame 8 in 0\.01 s"):
        carla_frames.collect(queues, 8, 0.01)
    queues["image"].put(types.SimpleNamespace(frame=9))
    with pytest.raises(carla_drives.CarlaError, match="sensor image sent frame 9 while 8"):
        carla_frames.collect(queues, 8, 0.01)


def test_plan_is_the_papers():
    jobs = carla_drives.plan()
    train = [job for job in jobs if job.split == "train"]
    assert len(train) == 100 and sum(job.frames for job in train) == 300_000 and len(jobs) == 140
    assert {job.weather for job in train} == set(carla_drives.WEATHERS)
    assert {job.weather for job in jobs if job.split == "val_ds"} <= set(carla_drives.SHIFTED_WEATHERS)
    assert len({(job.split, job.run) for job in jobs}) == len({job.seed for job in jobs}) == 140
    assert jobs == carla_drives.plan() != carla_drives.plan(seed=1)
    small = {(job.split, job.run): job for job in carla_drives.plan(train_runs=2)}
    assert all(job == small.get((job.split, job.run), job) for job in jobs)  # more runs keep those that there are


@pytest.mark.parametrize("nothing", [{"towns": ()}, {"train_runs": 0, "val_runs": 0}, {"run_s": 0.0},
                                     {"run_s": math.inf}, {"train_runs": -1}])
def test_a_plan_without_a_frame_is_refused(nothing):
    with pytest.raises(ValueError, match="expected a town, a run and a frame at least"):
        carla_drives.plan(**nothing)


def test_command_line_estimates_without_a_server(tmp_path, capsys):
    arguments = [str(tmp_path / "out"), "--estimate", "--train-runs=1", "--val-runs=0", "--towns", "Town01"]
    assert command_line.run(record_carla.Options, record_carla.record, program="record_carla", arguments=arguments) == 0
    assert "3000 of 3000 frames are missing: 12.7 GB and 0.1 hours" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_a_missing_client_names_the_extra_and_a_wrong_agent_the_form(monkeypatch):
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(carla_drives.CarlaError, match=r"muvo_jax\[carla\]"):
        carla_client.Client(SETTINGS)
    for name in ("json", "json:no_such_thing", "no_such_module:f", ":f"):
        with pytest.raises(ValueError, match="--agent="):
            carla_client.load_agent(name)
    assert carla_client.load_agent("json:loads") is json.loads


@needs_carla
def test_tags_and_poses_agree_with_the_clients_types():
    import carla
    tags = {name: int(value) for name, value in carla.CityObjectLabel.names.items() if name != "Any"}
    for name, expected in {"Roads": 7, "RoadLines": 6, "Sky": 13, "Car": 10, "Bus": 10, "Pedestrians": 4,
                           "Buildings": 1, "NONE": 0, "Terrain": 22, "TrafficLight": 18, "Water": 21}.items():
        assert muvo_files.LAYOUT_TAGS[tags[name]] == expected, name
    assert all(muvo_files.LAYOUT_TAGS[tag] for name, tag in tags.items() if name != "NONE")
    placed = carla.Transform(carla.Location(3, 4, 0), carla.Rotation(yaw=90, pitch=10))
    assert carla_frames.pose_of(placed) == pytest.approx((3, -4, -math.pi / 2))
    forward = placed.get_forward_vector()
    assert carla_frames.forward_speed(placed, forward * 7) == pytest.approx(7, rel=1e-5)
    detection = carla.SemanticLidarDetection()
    assert {"point", "cos_inc_angle", "object_idx", "object_tag"} <= set(dir(detection))


@needs_carla
def test_every_weather_is_one_of_the_clients_and_no_server_is_one_clear_error():
    import carla
    for name in {*carla_drives.WEATHERS, *carla_drives.SHIFTED_WEATHERS}:
        assert isinstance(getattr(carla.WeatherParameters, name), carla.WeatherParameters)
    with pytest.raises(carla_drives.CarlaError, match=r"CARLA at 127\.0\.0\.1:1: "):
        carla_client.Client(SETTINGS, port=1, timeout_s=0.2)


def test_an_estimate_reads_the_folder_of_a_user_and_a_run_without_a_row(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (job, *_) = jobs = carla_drives.plan(towns=("Town01",), train_runs=1, val_runs=1, run_s=10, seed=0)
    folder = tmp_path / "rec" / job.split / job.run
    folder.mkdir(parents=True)
    (folder / "frames.csv").write_text("frame_id,timestamp_s\n")
    assert carla_drives.estimate(pathlib.Path("~/rec"), jobs, carla_drives.Settings()).measured


def test_occupancy_that_was_made_later_is_no_part_of_an_estimate(tmp_path):
    (job, *_) = jobs = carla_drives.plan(towns=("Town01",), train_runs=2, val_runs=0, run_s=2.0)
    folder = tmp_path / job.split / job.run
    for name, time_s in (("image/000000.png", 0), ("frames.csv", 2), ("occupancy/000000.npz", 86_400)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"\n" * 21)
        os.utime(folder / name, (1e9 + time_s,) * 2)
    needed = carla_drives.estimate(tmp_path, jobs, carla_drives.Settings())
    assert needed.missing == 20 and needed.disk_bytes == 42 and needed.hours * 3600 == pytest.approx(2.0)
