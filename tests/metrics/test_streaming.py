"""Sums by drive: means, undefined values, and intervals that come from drives and not from windows."""

import numpy as np
import pytest

from muvo_jax.metrics import streaming


def sums_of(values_by_drive):
    sums = streaming.DriveSums()
    for drive, values in values_by_drive.items():
        values = np.asarray(values, float)
        sums.add((drive,) * len(values), streaming.mean_sums(values))
    return sums


def test_means_leave_out_what_is_undefined_and_count_it():
    sums = sums_of({"a": [[1.0, np.nan], [3.0, 4.0]], "b": [[5.0, np.nan]]})
    found = streaming.summary(sums, streaming.mean, 0)
    assert found["mean"] == pytest.approx((1 + 3 + 5 + 4) / 4) and found["per_step"] == [3.0, 4.0]
    assert sums.total()["undefined"].tolist() == [0, 2]


def test_an_interval_is_as_wide_as_drives_differ_however_many_windows_they_have():
    """Two drives, 0 and 1: half of the draws of two hold both, a quarter each only one of them."""
    few, many = (sums_of({"a": np.zeros((count, 1)), "b": np.ones((count, 1))}) for count in (1, 400))
    low, high = streaming.summary(many, streaming.mean, 0)["interval"]
    assert (low, high) == (0.0, 1.0)
    assert streaming.summary(few, streaming.mean, 0) == streaming.summary(many, streaming.mean, 0)
    alike = sums_of({name: [[0.0], [1.0]] for name in "abcdefgh"})
    assert streaming.summary(alike, streaming.mean, 0)["interval"] == [0.5, 0.5]


def test_intervals_are_those_of_the_normal_theory_where_drives_are_many():
    values = np.random.default_rng(1).normal(size=(200, 1))
    low, high = streaming.summary(sums_of({str(index): value[None] for index, value in enumerate(values)}),
                                  streaming.mean, 0)["interval"]
    half = 1.96 * values.std() / np.sqrt(200)
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.25 * half)


def test_one_drive_has_no_interval_and_nothing_defined_is_nan():
    assert np.isnan(streaming.summary(sums_of({"a": [[1.0], [2.0]]}), streaming.mean, 0)["interval"]).all()
    nothing = streaming.summary(sums_of({"a": [[np.nan]], "b": [[np.nan]]}), streaming.mean, 0)
    assert np.isnan([nothing["mean"], *nothing["interval"], *nothing["per_step"]]).all()


def test_two_sources_are_compared_on_the_same_draws():
    first, second = (sums_of({"a": [[0.0 + add]], "b": [[1.0 + add]], "c": [[5.0 + add]]}) for add in (0.0, 10.0))
    drawn = [streaming.mean(sums.resampled(7)) for sums in (first, second)]
    np.testing.assert_allclose(drawn[1] - drawn[0], 10.0)
