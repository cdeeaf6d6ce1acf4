"""What float32 decides by chance is told by magnitude and noise, whatever an entry is called."""


import jax
import jax.numpy as jnp
import numpy as np
import pytest

from muvo_jax import config as config_lib
from muvo_jax.interop.parity import cases, drawing, full_models, golden, rounding, runner
from muvo_jax.model import decoders

TOLERANCE = 1e-4
NOISE = 2e-7


def file_of(folder, **entries):
    np.savez(folder / "p.npz", **{name: np.float32(value) for name, value in entries.items()})
    return golden.File(folder / "p.npz")


def outcome(file, check):
    report, lines = runner.Report(), []
    runner.run_file(cases.FileChecks("p", ("p",), (lambda context: iter([check]),)),
                    cases.Context(file, golden.Settings()), report, lines.append)
    return report.passed == 1, lines[0]


def roundings(truth, noise=NOISE):
    """What weights moved back and forth lead to: moves of opposite sign in turns, far larger than the noise."""
    random = np.random.default_rng(0)
    moves = np.repeat(random.normal(size=8), 2) * np.tile([1e-5, -1e-5], 8)
    return lambda: iter(truth + moves + noise * random.normal(size=16))


@pytest.mark.parametrize("stored, got, passes", [
    (3.0e-4, 3.000e-4, True),             # near enough as first rounded
    (3.0e-4, 3.0e-4 + 2 * NOISE, True),   # 1.3e-3 of it, but as near as two roundings are
    (3.0e-4, 3.0e-4 + 3e-6, False),       # no rounding is that far off
    (3.0e-1, 3.0e-1 + 1e-4, False),       # not near zero: 3.3e-4 of it is an error
])
def test_a_number_near_zero_is_compared_in_its_noise(tmp_path, stored, got, passes):
    check = cases.Check("a", np.float32(got), TOLERANCE, roundings=roundings(got))
    assert outcome(file_of(tmp_path, a=stored), check)[0] == passes


def test_noise_that_is_none_of_roundings_excuses_nothing(tmp_path):
    """A function that jumps scatters far more than rounding does."""
    file = file_of(tmp_path, a=3e-4)
    wild = cases.Check("a", np.float32(3.5e-4), TOLERANCE, roundings=roundings(3.5e-4, noise=1e-3))
    passed, line = outcome(file, wild)
    assert not passed and "noise 1.0e-06" in line


def test_roundings_are_asked_for_only_where_they_can_help(tmp_path):
    def never():
        raise AssertionError("computed anew for nothing")

    large = cases.Check("a", np.float32(0.2), TOLERANCE, roundings=never)
    assert "AssertionError" not in outcome(file_of(tmp_path, a=0.1), large)[1]
    small = cases.Check("a", np.float32(1e-4), TOLERANCE, roundings=never)
    assert outcome(file_of(tmp_path, a=1e-4), small)[0]


def test_an_action_near_zero_of_a_real_decoder(tmp_path):
    """float64 NumPy stands for the reference: it passes, and does not where it is off by more than rounding."""
    decoder, where = decoders.ActionDecoder(), "decoders_action/"
    features = np.random.default_rng(3).normal(size=(1, 96)).astype(np.float32)
    variables, _ = drawing.prepared(decoder, features, where=where)
    act = jax.jit(lambda features: decoder.apply(variables, features[None])[1][0])
    for _ in range(20):  # Newton's way to an action near zero
        slope = np.asarray(jax.jacobian(act)(features[0]))
        features -= 0.5 * (np.linalg.pinv(slope) @ (np.asarray(act(features[0])) - [5e-4, -3e-4])).astype(np.float32)
    exact, layers = features.astype(np.float64), variables["params"]["mlp"]
    for index, name in enumerate(sorted(layers)):
        exact = exact @ layers[name]["kernel"].astype(np.float64) + layers[name]["bias"]
        exact = np.maximum(exact, 0) if index < len(layers) - 1 else np.tanh(exact)
    assert np.abs(exact).max() < 1e-3
    for apart, passes in ((0.0, True), (1e-5, False)):
        file = file_of(tmp_path, policy=exact + apart)
        assert outcome(file, drawing.action_check("policy", decoder, features, where, TOLERANCE))[0] == passes


def test_a_chamfer_gradient_is_known_as_far_as_expanded_squares_are(tmp_path):
    """The reference's formula in float32 NumPy: what it makes of near pairs and of ties passes, an error does not."""
    random = np.random.default_rng(5)
    targets = random.uniform(-30, 30, (1, 40, 3)).astype(np.float32)
    targets[0, 1] = targets[0, 0] + np.float32([1.0, 0.0, 0.0])
    points = (targets + random.normal(0, 0.3, targets.shape)).astype(np.float32)
    points[0, 0] = (targets[0, 0] + targets[0, 1]) / 2  # equally near to both
    noise = rounding.chamfer_gradient_noise(points, targets)
    assert noise.shape == points.shape and noise[0, 0, 0] > 2 / 40 > 10 * np.median(noise)

    def gradient(points, targets, dtype):
        points, targets = points[0].astype(dtype), targets[0].astype(dtype)
        squares = (points ** 2).sum(1)[:, None] + (targets ** 2).sum(1)[None] - 2 * points @ targets.T
        out = np.zeros(points.shape, dtype)
        for own, other in ((np.arange(40), squares.argmin(1)), (squares.argmin(0), np.arange(40))):
            distance = np.sqrt(squares[own, other])[:, None]
            np.add.at(out, own, (points[own] - targets[other]) / distance / 40)
        return out[None]

    ours, theirs = (gradient(points, targets, dtype) for dtype in (np.float64, np.float32))
    np.testing.assert_array_less(np.abs(ours - theirs), np.maximum(noise, 1e-8))
    wrong = theirs.copy()
    wrong[0, 7, 0] += 0.01 * np.abs(theirs).max()
    for stored, passes in ((theirs, True), (wrong, False)):
        check = cases.Check("grad", ours, 1e-5, noise=lambda: noise)
        assert outcome(file_of(tmp_path, grad=stored), check)[0] == passes


def test_the_choice_of_depth_bins_that_the_pack_made_is_kept_for_what_follows(tmp_path):
    """An embedding that jumps with a weight's rounding: the first that agrees with the file is the one that goes on."""
    encode = lambda weights: jnp.where(weights["a"] > 1.0, 2.0, 1.0)[None]
    config = config_lib.ModelConfig(camera=config_lib.BirdsEyeCamera())
    weights = {"a": np.float32(1.0)}
    for stored in (1.0, 2.0):
        context = cases.Context(file_of(tmp_path, embedding=[stored]), golden.Settings())
        embedding, check = full_models._encoded(context, config, encode, weights)
        np.testing.assert_array_equal(embedding, [stored])
        assert ("as first rounded" in check.note) == (stored == 2.0)
    plane = config_lib.ModelConfig()
    embedding, check = full_models._encoded(context, plane, encode, weights)
    np.testing.assert_array_equal(embedding, [1.0])
    assert check.note == ""


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_value_that_is_no_number_fails_where_only_some_are_stored(tmp_path, wrong):
    """Of a large entry every tenth value is stored, and what is between is seen in its statistics alone."""
    values = np.linspace(1.0, 2.0, 100, dtype=np.float32)
    statistics = np.array([values.mean(), values.std(), 1.0, 2.0, np.sqrt(np.square(values).sum())])
    np.savez(tmp_path / "p.npz", **{"a::sub": values[::10], "a::meta": np.array([10, 100]), "a::stats": statistics})
    file = golden.File(tmp_path / "p.npz")
    assert file.error("a", values) < 1e-6
    broken = values.copy()
    broken[3] = wrong
    assert file.error("a", broken) == np.inf
