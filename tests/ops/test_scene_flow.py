import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax.ops import scene_flow

SIDE, FAR = 32, scene_flow.REACH_CELLS
flow_of = jax.jit(scene_flow.cell_flow)


def seen(*boxes):
    """Evidence [X, Y, 2] of a scan that looked through everything but boxes of 4 x 2 cells, at their low corners."""
    evidence = np.full((SIDE, SIDE, 2), -1.0, np.float32)
    for x, y in boxes:
        evidence[x:x + 4, y:y + 2] = 1.0
    return evidence


def flow(newest, older):
    hits = jnp.asarray((newest > 0.0).astype(np.float32))
    return np.asarray(flow_of(hits[None], jnp.asarray(np.stack(older))[None]))[0]


@settings(deadline=None, max_examples=20)
@given(x=st.integers(-FAR, FAR), y=st.integers(-FAR, FAR))
def test_a_box_that_moves_is_given_its_motion_and_one_that_stands_none(x, y):
    stands = (4, 4)
    older = [seen((16 - x * lag, 16 - y * lag), stands) for lag in (3, 2, 1)]
    found = flow(seen((16, 16), stands), older)
    box = found[16:20, 16:18].reshape(-1, 2)
    if FAR in (abs(x), abs(y)):  # fast enough that older scans looked through most of where it is now
        np.testing.assert_allclose(box, np.broadcast_to([x, y], box.shape), atol=0.34)
    if (x, y) == (0, 0):
        assert not box.any()
    assert not found[4:8, 4:6].any()


def test_what_comes_into_sight_for_the_first_time_stays_where_it_is():
    unknown = np.zeros((SIDE, SIDE, 2), np.float32)
    assert not flow(seen((16, 16)), [unknown] * 3).any()
    assert not flow(seen((16, 16)), [seen()] * 3).any()  # it appeared: nothing says from where


def test_what_was_hidden_before_does_not_move():
    """Behind a wall that the car has passed: older scans know nothing of its place, and show something else nearby."""
    older = seen((14, 16))
    older[16:20, 16:18] = 0.0
    assert not flow(seen((16, 16)), [older] * 3).any()


def test_the_flow_is_float32_where_jax_counts_in_float64():
    with jax.enable_x64(True):
        hits, older = jnp.zeros((1, 8, 8, 2), jnp.float32), jnp.zeros((1, scene_flow.LAGS, 8, 8, 2), jnp.float32)
        assert jax.eval_shape(scene_flow.cell_flow, hits, older).dtype == jnp.float32
