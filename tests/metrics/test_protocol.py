"""The protocol: what is compared with what, at which step, and what becomes of undefined frames."""

import dataclasses

import jax
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax import presets, types
from muvo_jax.metrics import protocol

CONTEXT, HORIZON = 2, 3


@pytest.fixture
def config():
    config = presets.tiny()
    return dataclasses.replace(config, data=dataclasses.replace(config.data, context=CONTEXT, horizon=HORIZON))


def _batch(windows=2):
    """Frame t of every window is grey 10 t; its voxel t is occupied, voxel 7 unknown; one wall moves 1 m a frame."""
    frames = CONTEXT + HORIZON
    steps = np.arange(frames)
    image = np.broadcast_to((10 * steps).astype(np.uint8)[None, :, None, None, None], (windows, frames, 4, 4, 3)).copy()
    occupancy = np.zeros((windows, frames, 8, 1, 1), np.uint8)
    occupancy[:, steps, steps] = 1
    occupancy[:, :, 7] = 255
    range_view = np.zeros((windows, frames, 2, 2, 4), np.float32)
    range_view[..., 0] = 5.0 + steps[None, :, None, None]
    range_view[..., 3] = range_view[..., 0]
    return types.Batch(action=np.zeros((windows, frames, 2), np.float32), is_first=np.zeros((windows, frames), bool),
                       image=image, occupancy=occupancy, range_view=range_view)


def _perfect(batch):
    return {"image": batch.image.astype(np.float32) / 255.0, "range_view": batch.range_view,
            "occupancy": batch.occupancy == 1}


def _evaluate(monkeypatch, config, predictions, batches, mean=None, other=None, look=None):
    """Every real window is a drive of its own; with `other` these frames are imagined under other actions."""
    answers = iter(predictions)
    monkeypatch.setattr(protocol, "_predict", lambda *_: (next(answers), other))
    windows = [protocol.Windows(batch, tuple(f"{index}-{row}" for row in range(count)))
               for index, (batch, count) in enumerate(batches)]
    return protocol.evaluate(None, None, windows, config, mean, look=look)


def test_who_looks_sees_the_first_windows_as_every_source_has_them(monkeypatch, config):
    seen, batches = [], [_batch(), _batch()]
    _evaluate(monkeypatch, config, [_perfect(batch) for batch in batches], [(batch, 2) for batch in batches],
              look=lambda item, guesses: seen.append((item.batch, guesses)))
    (batch, guesses), = seen
    assert batch is batches[0] and {"model", "copy_last"} <= guesses["imagined"].keys()
    lengths = {phase: guesses[phase]["model"]["image"].shape[1] for phase in protocol.PHASES}
    assert lengths == {"observed": config.data.context, "imagined": config.data.horizon}


def test_two_processes_that_share_the_windows_report_what_one_does(monkeypatch, config):
    good, bad = _batch(), _batch()
    bad.image[:] = 255 - bad.image
    batches = [(good, 2), (bad, 1), (good, 1)]
    answer = _perfect(_batch())
    other = {name: value[:, CONTEXT:] for name, value in answer.items()}
    alone = _evaluate(monkeypatch, config, [answer] * 3, batches, other=other)
    seen = []

    def judge(process, gather):
        monkeypatch.setattr(protocol, "_predict", lambda *_: (answer, other))
        windows = [protocol.Windows(batch, tuple(f"{index}-{row}" for row in range(count)))
                   for index, (batch, count) in enumerate(batches)][process::2]
        return protocol.evaluate(None, None, windows, config, share=protocol.Share(process, 2, gather))

    judge(1, lambda value: seen.append(value) or [value])
    together = judge(0, lambda value: [value, *seen])
    assert (together["windows"], together["drives"]) == (alone["windows"], alone["drives"]) == (4, 4)
    for phase in protocol.PHASES:
        for source, scores in alone[phase].items():
            for name, score in scores.items():
                np.testing.assert_allclose(together[phase][source][name]["mean"], score["mean"], rtol=1e-12)


def test_a_perfect_model_is_perfect_and_copy_last_falls_behind_step_by_step(monkeypatch, config):
    batch = _batch()
    report = _evaluate(monkeypatch, config, [_perfect(batch)], [(batch, 2)])
    imagined = report["imagined"]
    assert imagined["model"]["chamfer_m"]["mean"] == 0.0
    assert imagined["model"]["psnr_db"]["mean"] == 100.0
    assert imagined["model"]["iou_occ_observed"]["mean"] == 1.0
    # The wall is 1, 2, 3 m away from where copy-last left it; the picture is 10, 20, 30 grey levels off.
    np.testing.assert_allclose(imagined["copy_last"]["chamfer_m"]["per_step"], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(imagined["copy_last"]["psnr_db"]["per_step"],
                               -20 * np.log10(np.array([10, 20, 30]) / 255), rtol=1e-5)
    assert imagined["copy_last"]["iou_occ_observed"]["per_step"] == [0.0, 0.0, 0.0]
    assert set(report["observed"]) == {"model"}
    assert report["copy_last_unknown_voxels"] == 2


def test_windows_that_fill_a_batch_do_not_count(monkeypatch, config):
    batch = _batch()
    wrong = {name: value.copy() for name, value in _perfect(batch).items()}
    wrong["image"][1] = 1.0
    report = _evaluate(monkeypatch, config, [wrong, _perfect(batch)], [(batch, 1), (batch, 2)])
    assert report["windows"] == 3
    scores = report["imagined"]["model"]["psnr_db"]
    assert (scores["mean"], scores["frames"]) == (100.0, 3 * HORIZON)


def test_a_frame_without_predicted_returns_is_counted_as_undefined_not_averaged(monkeypatch, config):
    batch = _batch()
    blind = {name: value.copy() for name, value in _perfect(batch).items()}
    blind["range_view"][0, :, ..., 3] = 0.5  # below the threshold of a return
    blind["range_view"][:, -1, ..., 3] = 0.5
    scores = _evaluate(monkeypatch, config, [blind], [(batch, 2)])["imagined"]["model"]["chamfer_m"]
    assert scores["undefined"] == 4 and scores["frames"] == 2
    np.testing.assert_array_equal(scores["per_step"], [0.0, 0.0, np.nan])
    assert scores["mean"] == 0.0


def test_nothing_defined_is_nan(monkeypatch, config):
    batch = _batch()
    blind = {**_perfect(batch), "range_view": np.zeros_like(batch.range_view)}
    scores = _evaluate(monkeypatch, config, [blind], [(batch, 2)])["imagined"]["model"]["chamfer_m"]
    assert np.isnan(scores["mean"]) and scores["frames"] == 0


def test_the_training_mean_is_scored_in_both_phases_and_missing_heads_in_none(monkeypatch, config):
    batch = _batch()
    mean = {"image": np.zeros((4, 4, 3), np.float32)}
    report = _evaluate(monkeypatch, config, [_perfect(batch)], [(batch, 2)], mean)
    assert set(report["imagined"]) == {"model", "copy_last", "training_mean"}
    assert set(report["observed"]) == {"model", "training_mean"}
    assert set(report["observed"]["training_mean"]) == {"psnr_db"}
    np.testing.assert_allclose(report["observed"]["training_mean"]["psnr_db"]["per_step"],
                               [100.0, -20 * np.log10(10 / 255)], rtol=1e-5)


def test_the_answer_to_actions_is_the_error_under_others_over_the_error_under_the_recorded_ones(monkeypatch, config):
    """The recorded actions leave an error of 1 grey level and 1 m, the others one of 3 grey levels and 1 m."""
    batch = _batch()
    part = batch.time_slice(CONTEXT, CONTEXT + HORIZON)

    def off(frames, grey, metres):
        guess = {"image": (frames.image.astype(np.float32) + grey) / 255.0, "range_view": frames.range_view.copy()}
        guess["range_view"][..., 3] += metres
        return guess

    report = _evaluate(monkeypatch, config, [off(batch, 1, 1.0)], [(batch, 2)], other=off(part, 3, -1.0))
    assert report["action_shuffle"]["image"]["mean"] == pytest.approx(9.0, rel=1e-4)
    assert report["action_shuffle"]["range_view"]["per_step"] == pytest.approx([1.0, 1.0, 1.0])
    assert "occupancy" not in report["action_shuffle"]


def test_movers_are_scored_by_the_pixels_and_voxels_they_cover(monkeypatch, config):
    grid = config_lib.VoxelGrid((8, 1, 1), 1.0, (-4.0, -0.5, 0.5))
    config = dataclasses.replace(config, model=dataclasses.replace(
        config.model, heads=("image",), voxels=grid))
    batch = _batch()
    pixels, voxels = np.zeros(batch.image.shape[:-1], bool), np.zeros(batch.occupancy.shape, bool)
    pixels[:, :, 0, 0] = voxels[:, :, 4:] = True  # the wall's voxels of the last step, the one of frame 4
    batch = batch.replace(image_moving_mask=pixels, occupancy_moving_mask=voxels)
    guess = _perfect(batch)
    guess["image"] = np.where(pixels[..., None], guess["image"] + 0.1, guess["image"])
    guess["occupancy"] = guess["occupancy"].copy()
    guess["occupancy"][:, :, :4] = False  # wrong, but no mover
    report = _evaluate(monkeypatch, config, [guess], [(batch, 2)])
    scores = report["imagined"]["model"]
    assert scores["psnr_movers_db"]["mean"] == pytest.approx(20.0, rel=1e-4) and scores["psnr_db"]["mean"] > 30
    assert scores["iou_occ_movers"]["mean"] == 1.0 and scores["iou_occ_above_observed"]["mean"] == pytest.approx(1 / 3)
    assert report["movers"] == "road users on the move"


def test_intervals_come_from_drives(monkeypatch, config):
    batch = _batch()
    wrong = {name: value.copy() for name, value in _perfect(batch).items()}
    wrong["occupancy"][1] = False
    low, high = _evaluate(monkeypatch, config, [wrong], [(batch, 2)])["imagined"]["model"]["iou_occ_observed"][
        "interval"]
    assert (low, high) == (0.0, 1.0)
    assert np.isnan(_evaluate(monkeypatch, config, [wrong], [(batch, 1)])["imagined"]["model"]["psnr_db"][
        "interval"]).all()


def test_unknown_voxels_are_ignored_or_empty(monkeypatch, config):
    batch = _batch()
    eager = {**_perfect(batch), "occupancy": _perfect(batch)["occupancy"] | (batch.occupancy == 255)}
    scores = _evaluate(monkeypatch, config, [eager], [(batch, 2)])["imagined"]["model"]
    assert scores["precision_observed"]["mean"] == 1.0
    assert scores["precision_all"]["mean"] == 0.5


def test_identity_names_what_two_numbers_must_share(config):
    text = protocol.identity(config)
    assert "context 2, horizon 3, 0.2 s a step" in text
    longer = dataclasses.replace(config, data=dataclasses.replace(config.data, horizon=4))
    assert protocol.identity(longer) != text


def test_imagined_steps_are_driven_by_the_action_before_them(monkeypatch, config):
    """Step k after the context must be imagined under action[context - 1 + k], without seeing any later frame."""
    calls = {}

    class Model:
        config = dataclasses.replace(presets.tiny().model, heads=("image",))

        def decode(self, variables, states, heads, memory):
            features = states.features
            return types.Predictions({"image": {1: features[..., :3].reshape(*features.shape[:-1], 1, 1, 3)}})

    def observe(model, variables, key, batch, *, sampled):
        calls["observed"] = batch.frames
        states = types.LatentState(np.zeros((2, batch.frames, 2)), np.zeros((2, batch.frames, 2)))
        return types.Observed(states, None, None)

    def imagine(model, variables, key, state, actions, *, sampled, same_noise):
        calls["actions"] = actions
        states = types.LatentState(*(np.ones((2, actions.shape[1], HORIZON, 2)) for _ in range(2)))
        return types.Dream(states, actions, None)

    monkeypatch.setattr(protocol.rollout, "observe", observe)
    monkeypatch.setattr(protocol.rollout, "imagine", imagine)
    batch = _batch()
    batch = batch.replace(action=np.arange(2 * 5 * 2, dtype=np.float32).reshape(2, 5, 2))
    with jax.disable_jit():
        frames = protocol.predict(Model(), {}, jax.random.key(0), batch, context=CONTEXT, horizon=HORIZON,
                                  sampled=False)
    assert calls["observed"] == CONTEXT
    np.testing.assert_array_equal(calls["actions"], batch.action[:, None, 1:4])
    np.testing.assert_array_equal(frames["image"][0, :, 0, 0, 0], [0, 0, 1, 1, 1])
