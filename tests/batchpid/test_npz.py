"""Files .npz that are damaged or made to do harm."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from batchpid.io.files import read_npz

ARRAYS = {
    "text": np.array("abc"),
    "numbers": np.arange(6.0).reshape(2, 3),
    "columns": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
    "empty": np.zeros((2, 0), np.float32),
    "flags": np.array([True, False]),
}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_it_reads_what_numpy_wrote(save, tmp_path):
    save(tmp_path / "a.npz", **ARRAYS)
    tables = read_npz(tmp_path / "a.npz", 10_000)
    assert tables.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(tables[name], array)
        assert tables[name].dtype == array.dtype.newbyteorder("=")
        assert tables[name].flags.writeable


def test_a_bomb_is_refused_before_it_is_decompressed(tmp_path):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, numbers=np.zeros(10_000_000))
    size = path.stat().st_size
    assert size < 100_000
    data = path.read_bytes()
    directory = data.rindex(b"PK\x01\x02")
    liar = data[: directory + 24] + (1000).to_bytes(4, "little") + data[directory + 28 :]
    for content, said in ((data, "80,000,128 bytes, more than"), (liar, "Bad CRC-32")):
        path.write_bytes(content)
        tracemalloc.start()
        with pytest.raises((ValueError, zipfile.BadZipFile), match=said):
            read_npz(path, size)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 2_000_000


def header(shape, descr="'<f8'"):
    """Return the bytes of an .npy file with 16 bytes of data."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(16)


@pytest.mark.parametrize(
    "content",
    [
        *(
            header(shape)
            for shape in ("(3,)", "(10**18,)", "(9999999999999999999,)", "(-1, -2)", "(2, 0)", "2", "(2.0,)")
        ),
        *(header((2,), descr) for descr in ("'|O'", "'U0'", "'<M8[s]'", "'|V8'", "[('a', '<f8')]", "'<c16'", "0")),
        header("(" * 9000 + "2"),
        header("(2,)")[:40],
        header("(2,)").replace(b"\x01\x00", b"\x09\x00", 1),
        b"",
    ],
)
def test_absurd_headers_are_refused(content, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(Exception, match=r"\S"):
        read_npz(tmp_path / "a.npz", 100_000)


def test_members_twice_encrypted_or_compressed_in_another_way_are_refused(tmp_path):
    path, array = tmp_path / "a.npz", io.BytesIO()
    np.save(array, np.zeros(1000))
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.writestr("a.npy", array.getvalue())
        with pytest.raises(ValueError, match="unknown way"):
            read_npz(path, 10_000)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", array.getvalue())
        archive.writestr("a", array.getvalue())
    with pytest.raises(ValueError, match="there twice"):
        read_npz(path, 100_000)
    np.savez(path, a=np.zeros(3))
    data = bytearray(path.read_bytes())
    data[data.rindex(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(RuntimeError, match="encrypted"):
        read_npz(path, 100_000)


def test_a_directory_cut_at_its_beginning_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(3), b=np.ones(3))
    data = path.read_bytes()
    first, second, end = data.index(b"PK\x01\x02"), data.rindex(b"PK\x01\x02"), data.rindex(b"PK\x05\x06")
    tail = bytearray(data[end:])
    tail[12:16], tail[16:20] = (end - second).to_bytes(4, "little"), (second).to_bytes(4, "little")
    path.write_bytes(data[:end] + tail)
    assert first < second
    with np.load(path) as file:
        assert file.files == ["b"]
    with pytest.raises(ValueError, match="list of arrays is damaged"):
        read_npz(path, 100_000)
