"""Errors of imagination, raised in Python before anything is compiled; each names what came and what was expected."""

from __future__ import annotations

import numbers

import jax
import jax.numpy as jnp
import numpy as np

from muvo_jax.model.encoders import COMMANDS
from muvo_jax.model.world_model import WorldModel, inputs
from muvo_jax.ops import conv
from muvo_jax.types import Batch, LatentState

ACTION_CHANNELS = 2
_ROUNDING = 1e-6
_RECORDED = 1e-3  # so far beyond 1 may recorded actions lie (data/fields.py)
_MOST = {"speed_mps": (10_000.0, "m/s"), "range_view": (10_000.0, "m"), "points": (10_000.0, "m")}


def state(model: WorldModel, latent: LatentState) -> tuple[int, ...]:
    """Returns the leading axes of a latent state.

    Raises:
      ValueError: if its last axes are not those of this model, both parts have other leading axes, one of these is
        empty, or a part is not float32 (it is whatever dtype the model computes in).
    """
    expected = jax.tree.map(lambda leaf: leaf.shape[1:], jax.eval_shape(lambda: model.initial_state(1)))
    leads = []
    for name in ("deterministic", "stochastic"):
        shape, tail = jnp.shape(getattr(latent, name)), getattr(expected, name)
        if shape[len(shape) - len(tail):] != tail:
            raise ValueError(f"state.{name}: got {list(shape)}, expected [{', '.join(map(str, ('...', *tail)))}]; this "
                             f"state belongs to another model.")
        if (dtype := jnp.result_type(getattr(latent, name))) != jnp.float32:
            raise ValueError(f"state.{name}: got {dtype}{list(shape)}, expected float32; cast it, "
                             f"state.replace({name}=state.{name}.astype(\"float32\")).")
        leads.append(shape[:len(shape) - len(tail)])
    vantage = latent.vantage
    if model.config.tracks_motion and vantage is None:
        raise ValueError("state: it has no vantage, but this model keeps track of its motion; take states of "
                         "`observe`, `observe_step` or `imagine`.")
    if vantage is not None and jnp.shape(vantage.last) != leads[0]:
        raise ValueError(f"state: deterministic has the leading axes {list(leads[0])}, vantage "
                         f"{list(jnp.shape(vantage.last))}.")
    if leads[0] != leads[1]:
        raise ValueError(f"state: deterministic has the leading axes {list(leads[0])}, stochastic {list(leads[1])}.")
    some(leads[0], "state")
    return leads[0]


def some(lead: tuple[int, ...], where: str) -> None:
    """Raises ValueError where leading axes hold no state at all."""
    if 0 in lead:
        raise ValueError(f"{where}: got states with the leading axes {list(lead)}, expected at least one state; leave "
                         f"the call out where there is none.")


def actions(given, lead: tuple[int, ...], horizon: int | None, branches: int | None) -> tuple[int | None, int]:
    """Returns (branches, horizon) as the actions imply them.

    Raises:
      ValueError: if they do not fit; for values that are concrete also where one is not finite or outside [-1, 1].
    """
    shape, rank = jnp.shape(given), len(lead)
    if len(shape) not in (rank + 2, rank + 3) or shape[:rank] != lead or shape[-1] != ACTION_CHANNELS:
        axes = "".join(f"{size}, " for size in lead)
        raise ValueError(f"imagine: got actions {list(shape)}, expected [{axes}H, 2] or [{axes}N, H, 2].")
    if horizon is not None and horizon != shape[-2]:
        raise ValueError(f"imagine: horizon={horizon}, but there are {shape[-2]} actions; leave horizon out.")
    has_branches = len(shape) == rank + 3
    if has_branches and branches not in (None, shape[rank]):
        raise ValueError(f"imagine: branches={branches}, but the actions have {shape[rank]}; leave branches out.")
    action_values(given, "imagine")
    return (shape[rank] if has_branches else branches), shape[-2]


def one_action(given, lead: tuple[int, ...], where: str, name: str = "action", *, clips: bool = False,
               recorded: bool = False) -> jax.Array:
    """Returns the action [*lead, 2] of one step as float32.

    Values on the host (NumPy, lists) are looked at. Those on a device are clipped to [-1, 1] there instead: to look at
    them the host would wait, at every step of a loop, for the device to catch up. Traced values pass.

    Args:
      clips: whether the caller clips all values, so that those on the host need only be finite.
      recorded: whether it may come from a recording, whose actions may lie a rounding beyond; they are clipped.

    Raises:
      ValueError: for another shape, or for values on the host that are not finite or outside [-1, 1].
    """
    expected = (*lead, ACTION_CHANNELS)
    if jnp.shape(given) != expected:
        raise ValueError(f"{where}: got {name} {list(jnp.shape(given))}, expected {list(expected)} (acceleration, "
                         f"steering).")
    if isinstance(given, jax.Array):
        on_device = given.astype(jnp.float32)
        return on_device if isinstance(given, jax.core.Tracer) else jnp.clip(on_device, -1.0, 1.0)
    clipped = np.clip(given, -1.0, 1.0)  # NaN stays
    action_values(clipped if clips else given, where, _RECORDED if recorded else _ROUNDING)
    return jnp.asarray(clipped if recorded else given, jnp.float32)


def action_values(given, where: str, beyond: float = _ROUNDING) -> None:
    """Raises ValueError where a concrete action is not finite or outside [-1, 1] by more than `beyond`; traced values
    pass."""
    if isinstance(given, jax.core.Tracer):
        return
    values = np.asarray(given)
    if not np.isfinite(values).all():
        count = np.count_nonzero(~np.isfinite(values))
        raise ValueError(f"{where}: {count} values of the actions {list(values.shape)} are not finite.")
    if values.size and np.abs(values).max() > 1.0 + beyond:
        raise ValueError(f"{where}: actions {list(values.shape)} reach from {values.min():g} to {values.max():g}, "
                         f"expected [-1, 1] (acceleration, steering; see muvo_jax.config.ActionContract).")


def chosen_actions(given, where: str) -> None:
    """Raises ValueError where a policy chose what is no number, naming the step; traced values pass.

    given: [..., H, 2], steps on the axis before the last.
    """
    if isinstance(given, jax.core.Tracer):
        return
    values = np.asarray(given)
    wrong = np.argwhere(~np.isfinite(values).all(axis=-1))
    if len(wrong):
        first = wrong[np.argmin(wrong[:, -1])]
        drive = f" of the drive {first[:-1].tolist()}" if len(first) > 1 else ""
        raise ValueError(f"{where}: at step {first[-1]}{drive} the policy chose {values[tuple(first)].tolist()}; "
                         f"expected finite numbers in [-1, 1] (acceleration, steering). Its parameters may be NaN: "
                         f"lower its learning rate.")


def scalar(where: str, **named) -> None:
    """Raises ValueError where a value, traced or not, is more than one number."""
    for name, value in named.items():
        if jnp.shape(value) != ():
            raise ValueError(f"{where}: got {name} {list(jnp.shape(value))}, expected one number for all; for one of "
                             f"each state map the call, jax.vmap(lambda state, {name}: ...).")


def finite(where: str, **named) -> None:
    """Raises ValueError where a concrete array holds NaN or infinity, naming it; traced values and integers pass.

    Of `points`, beside a `point_count`, only so many rows are looked at.
    """
    _finite(where, _without_padding(named, unseen=jax.core.Tracer))


def finite_on_host(where: str, **named) -> None:
    """As `finite`, but arrays on a device pass: in a step of a loop the host would wait to look at them."""
    _finite(where, {name: [leaf for leaf in jax.tree.leaves(tree) if not isinstance(leaf, jax.Array)]
                    for name, tree in _without_padding(named, unseen=jax.Array).items()})


def _without_padding(named: dict, unseen: type) -> dict:
    """The same with 0 in the rows of `points` beyond `point_count`; without points where one of both is `unseen`."""
    if not {"points", "point_count"} <= named.keys():
        return named
    if isinstance(named["points"], unseen) or isinstance(named["point_count"], unseen):
        return {name: value for name, value in named.items() if name != "points"}
    points, count = np.asarray(named["points"]), np.asarray(named["point_count"])
    padding = np.arange(points.shape[-2]) >= np.expand_dims(count, -1)
    return named | {"points": np.where(np.expand_dims(padding, -1), np.zeros((), points.dtype), points)}


def _finite(where: str, named: dict) -> None:
    for name, tree in named.items():
        for leaf in jax.tree.leaves(tree):
            if isinstance(leaf, jax.core.Tracer) or not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
                continue
            wrong = int((~np.isfinite(np.asarray(leaf))).sum())  # NumPy, lest a trace around the call sees it
            if wrong:
                raise ValueError(f"{where}: {name} {list(jnp.shape(leaf))} holds {wrong} values that are not finite.")


def observation(where: str, model: WorldModel, batch: Batch) -> None:
    """Raises ValueError where an input of the model, or an action, is concrete and not finite, or cannot be: an action
    outside [-1, 1], an unknown command, see `plausible`; also for a batch without windows or frames."""
    if not (batch.batch_size and batch.frames):
        raise ValueError(f"{where}: got a batch of {batch.batch_size} windows of {batch.frames} frames, expected at "
                         f"least one of both.")
    read = {"action": batch.action, "range_view": batch.range_view}
    read |= {name: getattr(batch, name) for name in inputs(model.config)}
    read = {name: value for name, value in read.items() if value is not None}
    finite(where, **read)
    action_values(batch.action, where, _RECORDED)
    plausible(where, read)
    arrivals(where, model, batch.ego_motion, batch.is_first)
    for name in ("command", "next_command"):
        known_commands(where, name, read.get(name))


def plausible(where: str, read: dict) -> None:
    """Raises ValueError where concrete speeds or ranges are far beyond any car's, or a camera cannot be; traced values
    pass. Finite as they are, states and pictures would not be."""
    seen = {name: np.asarray(value) for name, value in _without_padding(read, unseen=jax.core.Tracer).items()
            if name in {*_MOST, "intrinsics", "camera_to_ego"} and not isinstance(value, jax.core.Tracer)}
    for name in _MOST.keys() & seen.keys():
        (most, unit), values = _MOST[name], seen[name]
        if values.size and max(values.max(), -values.min()) > most:
            raise ValueError(f"{where}: {name} {list(values.shape)} reaches from {values.min():g} to "
                             f"{values.max():g} {unit}; expected at most {most:g} {unit} either way.")
    if "intrinsics" in seen:
        focal_px = seen["intrinsics"][:, (0, 1), (0, 1)]
        wrong = np.flatnonzero((focal_px <= 0.0).any(axis=-1))
        if wrong.size:
            raise ValueError(f"{where}: intrinsics of window {wrong[0]} have the focal lengths "
                             f"{focal_px[wrong[0]].tolist()} px; expected fx and fy above 0, at [0, 0] and [1, 1].")
    if "camera_to_ego" in seen:
        turn = seen["camera_to_ego"][:, :3, :3]
        skewed = np.abs(turn @ turn.swapaxes(-1, -2) - np.eye(3)[None]).max(axis=(-2, -1))
        wrong = np.flatnonzero((skewed >= 0.1) | (np.linalg.det(turn) < 0.0))
        if wrong.size:
            raise ValueError(f"{where}: camera_to_ego of window {wrong[0]} has {turn[wrong[0]].tolist()} in its first "
                             f"three rows and columns; expected a rotation.")


def arrivals(where: str, model: WorldModel, given, is_first) -> None:
    """Raises ValueError where ego motion [..., 4] that moves the model's memory is concrete and not finite.

    None and traced values pass, and how the car came to a frame that `is_first` [...] may be anything.
    """
    moves = model.config.tracks_motion and model.config.kinematics is None
    if given is None or not moves or isinstance(given, jax.core.Tracer) or np.isfinite(given).all():
        return  # before `is_first` is looked at: in a stream it lies on the device
    if not isinstance(is_first, jax.core.Tracer):
        unknown = np.expand_dims(np.asarray(is_first), -1) & (np.arange(4) < 3)
        _finite(where, {"ego_motion": np.where(unknown, np.float32(0.0), np.asarray(given))})


def known_commands(where: str, name: str, given) -> None:
    """Raises ValueError where commands of the navigation are concrete and none; None and traced values pass."""
    if given is None or isinstance(given, jax.core.Tracer):
        return
    values = np.asarray(given)
    wrong = values[(values < 0) | (values >= COMMANDS)]
    if wrong.size:
        raise ValueError(f"{where}: {name} {list(values.shape)} holds {wrong[0]}; expected 0 to {COMMANDS - 1} (left, "
                         f"right, straight, follow the lane, change to the left, change to the right).")


def forward_mode(where: str, model: WorldModel, *trees) -> None:
    """Raises TypeError where jvp, jacfwd or hessian differentiate through convolutions that know reverse mode alone.

    Only what is differentiated directly can be seen: under jit, JAX says it in its own words.
    """
    if not conv.reverse_only(model.config.convolution):
        return
    for leaf in jax.tree.leaves(trees):
        while isinstance(leaf, jax.core.Tracer):
            if type(leaf).__name__ == "JVPTracer":
                raise TypeError(f"{where}: forward-mode derivatives (jvp, jacfwd, hessian) do not pass the "
                                f"convolutions' fast forms; jax.grad does. Take a model with convolution \"xla\", "
                                f"which reads the same variables: WorldModel(dataclasses.replace(model.config, "
                                f"convolution=\"xla\")).")
            leaf = getattr(leaf, "primal", getattr(leaf, "val", None))


def counts(horizon: int | None, branches: int | None, where: str = "imagine") -> int:
    """Returns the horizon.

    Raises:
      ValueError: if there is none, or it or the number of branches is below 1.
    """
    if horizon is None:
        raise ValueError(f"{where}: a policy needs a horizon; pass horizon=number of steps.")
    for name, count in (("horizon", horizon), ("branches", branches)):
        if count is not None and (isinstance(count, bool) or not isinstance(count, numbers.Integral)):
            raise ValueError(f"{where}: {name} is {count!r}; expected a whole number.")
    if horizon < 1:
        raise ValueError(f"{where}: horizon is {horizon}; it must be at least 1.")
    if branches is not None and branches < 1:
        raise ValueError(f"{where}: branches is {branches}; it must be at least 1.")
    return horizon


def policy_action(action: jax.Array, features: jax.Array) -> jax.Array:
    """Returns what a policy chose for [B] states, clipped to [-1, 1].

    Raises:
      ValueError: while tracing, unless it is a floating-point array [B, 2].
    """
    expected = (features.shape[0], ACTION_CHANNELS)
    if not isinstance(action, jax.Array) or action.shape != expected or not jnp.issubdtype(action.dtype, jnp.floating):
        came = f"{action.dtype}{list(action.shape[1:])}" if isinstance(action, jax.Array) else jax.tree.map(
            lambda leaf: leaf.shape[1:], action)
        raise ValueError(f"imagine: for features {list(features.shape[1:])} the policy returned {came}, expected a "
                         f"float32[2] action (acceleration, steering) in [-1, 1].")
    return jnp.clip(action.astype(jnp.float32), -1.0, 1.0)
