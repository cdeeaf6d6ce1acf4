"""Pickles of several library versions are read; hostile and damaged ones are refused without executing anything."""

import io
import os
import pathlib
import pickle
import pickletools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from muvo_jax.data import schema
from muvo_jax.data.muvo import frame_pickle, pickle_repeats, pickle_standins, safe_pickle

FOLDER = pathlib.Path(__file__).parents[2] / "golden" / "pickles"
FRAMES = sorted(FOLDER.glob("*.pkl"))


@pytest.mark.parametrize("path", FRAMES, ids=lambda path: path.stem)
def test_frames_of_several_versions(path):
    table = safe_pickle.load_table(path)
    assert list(table)[:4] == ["action", "reward", "value", "image_path"] and table["voxel_path"][4].endswith("04.npy")
    np.testing.assert_array_equal(table["reward"], np.linspace(0, 1, 5))
    for row in range(5):
        np.testing.assert_array_equal(table["action"][row], np.arange(3, dtype=np.float32) + row)
        assert table["action"][row].dtype == np.float32
    assert list(table["image_path"]) == [f"image/image_{row:09d}.png" for row in range(5)]
    assert list(table["n_vehicles"]) == [[80, 160]] * 5
    assert table["is_expert"].dtype == bool and table["n_classes"].tolist() == [8] * 5
    assert list(table["weather"]) == ["ClearNoon"] * 5
    assert table["sc"][1] == np.float32(1) and table["sc"][0] == "x"


@pytest.mark.parametrize("name", ["points_numpy1.npy", "points_numpy2.npy"])
def test_pickled_points(name):
    points = safe_pickle.load_npy(FOLDER / name)
    np.testing.assert_array_equal(points["points_xyz"],
                                  np.random.default_rng(0).normal(0, 10, (7, 3)).astype(np.float32))
    np.testing.assert_array_equal(points["ObjTag"], np.arange(7, dtype=np.uint8))


def test_plain_arrays(tmp_path):
    for array in (np.arange(8, dtype=np.uint16).reshape(2, 4), np.asfortranarray(np.eye(3)), np.zeros((0, 4), ">u2")):
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_array_equal(safe_pickle.load_npy(tmp_path / "a.npy"), array)


def long_frame(rows=2500):
    """A frame whose columns repeat themselves but for their content, and some whose do not quite."""
    random = np.random.default_rng(0)
    same = [80, 160]
    return frame_pickle.frame({
        "action": list(random.normal(size=(rows, 3)).astype(np.float32)),
        "speed": [np.array([row], ">f8") for row in range(rows)],
        "image_path": [f"image/image_{row:09d}.png" for row in range(rows)], "name": [f"ä{row}" for row in range(rows)],
        "uneven": [np.arange(row % 3 + 1) for row in range(rows)], "command": [np.array([4], np.int8)] * rows,
        "n_vehicles": [same] * rows, "reward": random.normal(size=rows), "lists": [[row, 2] for row in range(rows)]})


def test_columns_that_repeat_are_read_at_once_and_the_same(monkeypatch, tmp_path):
    opcodes, step = [], safe_pickle._Unpickler._opcode
    monkeypatch.setattr(safe_pickle._Unpickler, "_opcode", lambda self: opcodes.append(0) or step(self))
    (tmp_path / "f.pkl").write_bytes(long_frame())
    together = safe_pickle.load_table(tmp_path / "f.pkl")
    count = len(opcodes)
    monkeypatch.setattr(pickle_repeats, "LONGEST_BYTES", 0)
    one_by_one = safe_pickle.load_table(tmp_path / "f.pkl")
    assert count < 0.4 * (len(opcodes) - count), "only lists and arrays of several sizes are read one by one"
    assert together["action"].shape == (2500, 3) and together["speed"].dtype == np.float64
    assert_same_tables(together, one_by_one)


def assert_same_tables(one, other):
    assert list(one) == list(other)
    for name in one:
        assert type(one[name]) is type(other[name]) and len(one[name]) == len(other[name])
        for mine, theirs in zip(one[name], other[name], strict=True):
            assert type(mine) is type(theirs)
            np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_items_that_were_read_at_once_may_be_referred_to(protocol, tmp_path):
    arrays = [np.array([row, 0, 1], np.float32) for row in range(300)]
    names = [f"name {row:03d}" for row in range(300)]
    content = pickle.dumps({"arrays": arrays, "names": names, "again": arrays[::-7] + names[::-7], "last": arrays[-1]},
                           protocol)
    (tmp_path / "f.npy").write_bytes(object_header() + content)
    read = safe_pickle.load_npy(tmp_path / "f.npy")
    expected = pickle.loads(content)
    for name in ("arrays", "again"):
        assert len(read[name]) == len(expected[name])
        for mine, theirs in zip(read[name], expected[name], strict=True):
            np.testing.assert_array_equal(mine, theirs)
    assert read["names"] == names and read["last"].tolist() == [299, 0, 1]


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_repeats_are_refused_or_read_as_one_by_one(data, tmp_path_factory):
    content = bytearray(long_frame(40))
    for _ in range(data.draw(st.integers(1, 3))):
        position = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            content[position] = data.draw(st.integers(0, 255))
        else:
            del content[position:position + data.draw(st.integers(1, 40))]
    damaged = tmp_path_factory.getbasetemp() / "repeats.pkl"
    damaged.write_bytes(content)
    try:
        together = safe_pickle.load_table(damaged)
    except schema.DataError:
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pickle_repeats, "LONGEST_BYTES", 0)
        assert_same_tables(together, safe_pickle.load_table(damaged))


class Runs:
    """Unpickling this runs a command that leaves a file."""

    def __init__(self, marker):
        self.command = f"touch '{marker}'"

    def __reduce__(self):
        return os.system, (self.command,)


class Evaluates(Runs):
    def __reduce__(self):
        return eval, (f"__import__('os').system({self.command!r})",)


class State(Runs):
    """The command hides in the state of an array of objects."""

    def __reduce__(self):
        return np._core.multiarray._reconstruct, (np.ndarray, (0,), b"b"), (
            1, (1,), np.dtype("O"), False, [Runs.__new__(Runs)])

    def __init__(self, marker):
        super().__init__(marker)
        Runs.command = self.command


@pytest.mark.parametrize("payload", [Runs, Evaluates, State])
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_commands_are_refused_and_do_not_run(payload, protocol, tmp_path):
    marker = tmp_path / "executed"
    content = pickle.dumps([payload(marker)], protocol)
    pickle.loads(content)
    assert marker.exists(), "the payload works where it is not refused"
    marker.unlink()
    (tmp_path / "pd_dataframe.pkl").write_bytes(content)
    with pytest.raises(pickle_standins.Refused, match=r"pd_dataframe\.pkl: "):
        safe_pickle.load_table(tmp_path / "pd_dataframe.pkl")
    for value in ({"points_xyz": payload(marker)}, [payload(marker)]):
        (tmp_path / "points.npy").write_bytes(object_header() + pickle.dumps(value, max(protocol, 2)))
        with pytest.raises(pickle_standins.Refused, match=r"points\.npy: asks for "):
            safe_pickle.load_npy(tmp_path / "points.npy")
    assert not marker.exists()


@pytest.mark.parametrize(("content", "message"), [
    (b"cos\nsystem\n(S'true'\ntR.", "asks for os.system"),
    (b"(S'true'\nios\nsystem\n.", "opcode b'\\(?[Si]"),  # INST
    (b"\x80\x02\x82\x01.", "opcode b'\\\\x82'"),  # copyreg extension
    (b"\x80\x04P1\n.", "opcode b'P'"),  # persistent id
    (b"\x80\x04\x8c\x08builtins\x8c\x07getattr\x93.", "asks for builtins.getattr"),
    (b"\x80\x04\x8c\x05numpy\x8c\x08fromfile\x93.", "asks for numpy.fromfile"),
    (b"\x80\x04]}b.", "gives a state to a list"),
    (b"\x80\x04K\x01)R.", "calls a int"),
    (b"\x80\x05\x96" + (1 << 50).to_bytes(8, "little") + b".", "more than the file has"),
    (b"\x80\x04\x8c\x05numpy\x8c\x05dtype\x93\x8c\x02V8\x85R.", "dtype V8"),
    (b"", "EOFError"),
    (b"\x80\x63.", "unsupported pickle protocol"),
])
def test_what_data_does_not_need(content, message, tmp_path):
    (tmp_path / "f.pkl").write_bytes(content)
    with pytest.raises(pickle_standins.Refused, match=message):
        safe_pickle.load_table(tmp_path / "f.pkl")


NESTED = b"\x80\x04)\x94" + b"".join(b"h" + bytes([index]) + b"h" + bytes([index]) + b"\x86\x94" for index in range(60))
SHAPED = b"\x80\x04\x8c\x16numpy._core.multiarray\x8c\x0c_reconstruct\x93)R"


@pytest.mark.parametrize("use", [
    b"}h\x3cK\x01s.",  # as a key: endless to hash
    b"h\x3c.", b"]h\x3ca.", b"}\x8c\x01ah\x3cs.",  # as a value: endless to copy
    b"h\x3c)R.",  # as a callable
    b"\x8c\x05numpy\x8c\x05dtype\x93h\x3c\x85R.",  # as an argument: endless to print
    SHAPED[2:] + b"(K\x01h\x3cNNNtb.",  # as a shape
], ids=["key", "value", "item", "entry", "callable", "dtype", "shape"])
def test_what_would_take_for_ever_is_refused_at_once(use, tmp_path):
    """Tuples of twice the same tuple, sixty deep: small in the file."""
    (tmp_path / "f.npy").write_bytes(object_header() + NESTED + use)
    with pytest.raises(schema.DataError):
        safe_pickle.load_npy(tmp_path / "f.npy")


def test_a_dict_that_is_referred_to_again_is_made_once(tmp_path):
    path, shared = tmp_path / "scan.npy", {"ObjTag": np.zeros(2, np.uint8)}
    path.write_bytes(frame_pickle.npy_of_dict({"one": {"in": shared}, "other": {"in": shared}}))
    scan = safe_pickle.load_npy(path)
    assert scan["one"]["in"] is scan["other"]["in"] and scan["one"]["in"]["ObjTag"].shape == (2,)


def object_header():
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
    return file.getvalue()


@pytest.mark.parametrize("path", [FRAMES[0], *FRAMES[-2:], FOLDER / "points_numpy2.npy"], ids=lambda path: path.stem)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_files_give_our_own_errors(path, data, tmp_path_factory):
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        position = data.draw(st.integers(0, len(content) - 1))
        change = data.draw(st.sampled_from(["flip", "cut", "insert", "opcode"]))
        if change == "flip":
            content[position] = data.draw(st.integers(0, 255))
        elif change == "cut":
            del content[position:position + data.draw(st.integers(1, 40))]
        elif change == "insert":
            content[position:position] = data.draw(st.binary(min_size=1, max_size=9))
        else:
            content[position] = ord(data.draw(st.sampled_from(pickletools.opcodes)).code)
    damaged = tmp_path_factory.getbasetemp() / path.name
    damaged.write_bytes(content)
    load = safe_pickle.load_npy if path.suffix == ".npy" else safe_pickle.load_table
    try:
        load(damaged)
    except schema.DataError as error:
        assert path.name in str(error)
