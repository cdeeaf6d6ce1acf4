"""Reading files of torch.save and of safetensors: both formats, all precisions, and what must be refused."""

import collections
import json
import os
import pickle
import struct
import zipfile

import ml_dtypes
import numpy as np
import pytest
import torch_writer

from muvo_jax import safetensors_file
from muvo_jax.interop import torch_file

WRITERS = {"zip": torch_writer.write_zip, "legacy": torch_writer.write_legacy}
ARRAYS = {"float32": np.arange(12, dtype=np.float32).reshape(3, 4), "float16": np.float16([[1.5, -2.0]]),
          "bfloat16": np.array([0.5, 3.0], ml_dtypes.bfloat16), "int64": np.array(7)}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_what_was_written_is_read(write, tmp_path):
    value = {"epoch": 3, "state_dict": torch_writer.tensors(ARRAYS), "nested": [(1, "x"), None],
             "hparams": torch_writer.ForeignObject("yacs.config", "CfgNode", {"LR": 1e-4}),
             "optimizer_states": [{"state": {0: {"exp_avg": torch_writer.Tensor(np.ones(3, np.float32))}}}]}
    write(tmp_path / "a.ckpt", value)
    read = torch_file.load(tmp_path / "a.ckpt")
    assert read["epoch"] == 3 and read["nested"] == [(1, "x"), None]
    assert isinstance(read["hparams"], torch_file.Foreign) and read["hparams"].state == {"LR": 1e-4}
    np.testing.assert_array_equal(read["optimizer_states"][0]["state"][0]["exp_avg"], [1, 1, 1])
    for name, array in ARRAYS.items():
        got = read["state_dict"][name]
        assert got.dtype == array.dtype and got.shape == array.shape and not got.flags.writeable
        np.testing.assert_array_equal(got, array)


def test_views_and_compression(tmp_path):
    whole = np.arange(12, dtype=np.float32)
    transposed = torch_writer.Tensor(whole, offset=2, shape=(2, 3), strides=(1, 2))
    torch_writer.write_zip(tmp_path / "a.pt", {"x": transposed}, zipfile.ZIP_DEFLATED)
    np.testing.assert_array_equal(torch_file.load(tmp_path / "a.pt")["x"], [[2, 4, 6], [3, 5, 7]])


class Call:
    def __init__(self, function, *args):
        self.function, self.args = function, args

    def __reduce__(self):
        return self.function, self.args


# Pickles of protocol 2 as Python writes them of a class torch.optim.lr_scheduler.OneCycleLR.
_OF_CLASS = b"ctorch.optim.lr_scheduler\nOneCycleLR\n"
_OF_OBJECT = _OF_CLASS + b")\x81}X\x0b\x00\x00\x00total_stepsK\x64sb"


@pytest.mark.parametrize("owner", [_OF_CLASS, _OF_OBJECT], ids=["static", "bound"])
def test_lightnings_schedulers_before_torch_2_4_name_a_method_of_their_own(owner, tmp_path):
    """OneCycleLR.state_dict()["anneal_func"], https://github.com/pytorch/pytorch/pull/123775; the authors have 2.0."""
    method = b"c__builtin__\ngetattr\n" + owner + b"X\x0e\x00\x00\x00_annealing_cos\x86R"
    with zipfile.ZipFile(tmp_path / "a.ckpt", "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02}X\x0b\x00\x00\x00anneal_func" + method + b"s.")
    read = torch_file.load(tmp_path / "a.ckpt")
    assert isinstance(read["anneal_func"], torch_file.Foreign) and read["anneal_func"].args[1] == "_annealing_cos"


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
@pytest.mark.parametrize("function", ["system", "eval", "getattr"])
def test_code_is_refused_and_not_executed(write, function, tmp_path):
    mark = tmp_path / "executed"
    call = {"system": Call(os.system, f"touch {mark}"), "eval": Call(eval, f"open({str(mark)!r}, 'w')"),
            "getattr": Call(getattr, "x", "upper")}[function]
    write(tmp_path / "evil.ckpt", {"state_dict": torch_writer.tensors(ARRAYS), "callbacks": call})
    with pytest.raises(torch_file.TorchFileError, match=rf"evil\.ckpt: expected .* it asks for \w+\.{function}.*"
                                                        r"nothing was executed"):
        torch_file.load(tmp_path / "evil.ckpt")
    assert not mark.exists()


def test_damaged_and_foreign_files(tmp_path):
    def refused(content, message):
        (tmp_path / "b.ckpt").write_bytes(content)
        with pytest.raises(torch_file.TorchFileError, match=rf"b\.ckpt: expected a checkpoint of .*{message}"):
            torch_file.load(tmp_path / "b.ckpt")

    torch_writer.write_zip(tmp_path / "a.ckpt", torch_writer.tensors(ARRAYS))
    torch_writer.write_legacy(tmp_path / "old.ckpt", torch_writer.tensors(ARRAYS))
    whole = (tmp_path / "a.ckpt").read_bytes()
    refused(whole[:len(whole) // 2], "cut short or damaged")
    refused((tmp_path / "old.ckpt").read_bytes()[:-5], "cut short")
    refused(b"", "damaged or something else")
    refused(b"\x89PNG not a checkpoint", "damaged or something else")
    refused(pickle.dumps({"a": 1}), "a pickle of something else")
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    refused((tmp_path / "c.zip").read_bytes(), "a zip file without data.pkl")
    with pytest.raises(torch_file.TorchFileError, match="cannot be opened"):
        torch_file.load(tmp_path / "nowhere.ckpt")


def test_a_bit_that_flipped_and_a_bomb_are_refused(tmp_path):
    path = tmp_path / "a.ckpt"
    torch_writer.write_zip(path, torch_writer.tensors(ARRAYS))
    content = bytearray(path.read_bytes())
    content[content.index(ARRAYS["float32"].tobytes()) + 6] ^= 1
    path.write_bytes(content)
    with pytest.raises(torch_file.TorchFileError, match=r"a\.ckpt: .*Bad CRC-32 for file 'archive/data/0'"):
        torch_file.load(path)
    torch_writer.write_zip(path, {"x": torch_writer.Tensor(np.zeros(2**22, np.float32))}, zipfile.ZIP_DEFLATED)
    with pytest.raises(torch_file.TorchFileError, match="would unpack to more than 64 times"):
        torch_file.load(path)


@pytest.mark.parametrize("stream", [
    b"(S'x'\nios\nsystem\n.", b"(cos\nsystem\nX\1\0\0\0xo.", b"cbuiltins\ndict\n)\x81}X\1\0\0\0xcos\nsystem\nsb.",
    b"(cos\nsystem\nX\1\0\0\0xtQ.", b"Pos.system\n.", b"\x82\1."],
    ids=["inst", "obj", "build", "binpersid", "persid", "ext"])
def test_no_opcode_reaches_code(stream, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.ckpt", "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + stream)
    with pytest.raises(torch_file.TorchFileError, match=r"asks for os\.system|refers to a str|unregistered extension"):
        torch_file.load(tmp_path / "a.ckpt")


def test_what_refers_to_itself_or_to_a_far_memo_is_read_once(tmp_path):
    nested, circle = ["x"], []
    for _ in range(40):
        nested = [nested] * 10  # 10**40 strings, 41 lists
    circle.append(circle)
    torch_writer.write_zip(tmp_path / "a.ckpt", {"nested": nested, "circle": circle})
    read = torch_file.load(tmp_path / "a.ckpt")
    assert read["nested"][3] is read["nested"][7] and read["circle"][0] is read["circle"]
    with zipfile.ZipFile(tmp_path / "b.ckpt", "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02]r\xff\xff\xff\x7f.")  # 34 GB of memo in pickle's C form
    assert torch_file.load(tmp_path / "b.ckpt") == []


def test_a_tensor_beyond_its_storage_is_refused(tmp_path):
    far = torch_writer.Tensor(np.arange(4, dtype=np.float32), offset=2, shape=(3,))
    torch_writer.write_zip(tmp_path / "a.pt", collections.OrderedDict(x=far))
    with pytest.raises(torch_file.TorchFileError, match="beyond its storage"):
        torch_file.load(tmp_path / "a.pt")


def test_safetensors_round_trip_and_damage(tmp_path):
    path = tmp_path / "w.safetensors"
    safetensors_file.save(path, ARRAYS, {"variant": "RV-WOB-TR"})
    read = safetensors_file.load(path)
    assert read.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert read[name].dtype == array.dtype
        np.testing.assert_array_equal(read[name], array)
    content = path.read_bytes()
    bad_offsets = json.dumps({"x": {"dtype": "F32", "shape": [4], "data_offsets": [0, 8]}}).encode()
    for damaged in (content[:-3], content[:5], b"x" * 40, struct.pack("<Q", len(bad_offsets)) + bad_offsets + bytes(8)):
        path.write_bytes(damaged)
        with pytest.raises(safetensors_file.SafetensorsError, match=r"w\.safetensors: expected a safetensors file"):
            safetensors_file.load(path)
    entry = lambda start: {"dtype": "F32", "shape": [2], "data_offsets": [start, start + 8]}
    for header, data_bytes, message in (
            ({"x": entry(0), "y": entry(4)}, 12, "y begins at byte 4 of the data, expected 8"),
            ({"x": entry(0)}, 12, "its tensors have 8 bytes, the file has 12"),
            ({"x": {"dtype": "F32", "shape": [-1, -2], "data_offsets": [0, 8]}}, 8, r"x has the shape \[-1, -2\]")):
        encoded = json.dumps(header).encode()
        path.write_bytes(struct.pack("<Q", len(encoded)) + encoded + bytes(data_bytes))
        with pytest.raises(safetensors_file.SafetensorsError, match=message):
            safetensors_file.load(path)
    with pytest.raises(ValueError, match="no dtype complex64"):
        safetensors_file.save(path, {"x": np.zeros(2, np.complex64)})
    assert list(tmp_path.iterdir()) == [path]


def test_safetensors_of_the_library_are_read(tmp_path):
    library = pytest.importorskip("safetensors.numpy")
    library.save_file({name: array for name, array in ARRAYS.items() if name != "bfloat16"}, tmp_path / "l.safetensors")
    read = safetensors_file.load(tmp_path / "l.safetensors")
    np.testing.assert_array_equal(read["float32"], ARRAYS["float32"])


@pytest.mark.parametrize("name", ["complex64", "float8_e4m3fn", "uint16"])
def test_a_type_of_numbers_that_numpy_lacks_is_named(name, tmp_path):
    with pytest.raises(torch_file.TorchFileError, match=rf"it holds tensors of .*{name}, which are not supported"):
        torch_file._Storage(type(name, (torch_file.Foreign,), {}), 3)
