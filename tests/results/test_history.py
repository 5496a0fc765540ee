"""`history.npz`, streamed."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from staf_torch.results.archive import Archive, _short_directory
from staf_torch.results.run_directory import HistoryWriter
from staf_torch.results.untrusted import UnreadableError


def arrays(batch: int, times: int, dtype: str = "float64") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "state": rng.normal(size=(batch, times, 3)).astype(dtype),
        "value": rng.normal(size=(batch, times)).astype(dtype),
        "weights": rng.normal(size=(batch, times, 2, 4)).astype(dtype),
    }


def write(path: Path, data: dict[str, np.ndarray], cuts: list[int], **whole: np.ndarray) -> None:
    batch, times = data["value"].shape
    with HistoryWriter(path, batch, times) as writer:
        for start, stop in zip([0, *cuts], [*cuts, times], strict=True):
            if stop > start:
                writer.add({name: array[:, start:stop] for name, array in data.items()})
        writer.close(**whole)


@given(
    batch=some.integers(1, 4),
    times=some.integers(1, 12),
    data=some.data(),
    dtype=some.sampled_from(["f4", "f8"]),
)
def test_streamed_archive_equals_the_arrays_in_memory(
    tmp_path_factory: pytest.TempPathFactory, batch: int, times: int, data: some.DataObject, dtype: str
) -> None:
    cuts = sorted(data.draw(some.lists(some.integers(0, times), max_size=4)))
    expected = arrays(batch, times, dtype)
    path = tmp_path_factory.mktemp("history") / "history.npz"
    write(path, expected, cuts, time=np.arange(times) * 0.1)
    with np.load(path) as found:
        assert set(found) == {*expected, "time"}
        for name, array in expected.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)
        np.testing.assert_array_equal(found["time"], np.arange(times) * 0.1)
    assert [entry.name for entry in path.parent.iterdir()] == ["history.npz"]


def test_pieces_that_are_not_contiguous_are_stored_as_they_read(tmp_path: Path) -> None:
    data = {"value": np.arange(12.0).reshape(3, 4).T.copy()[:, ::-1]}
    write(tmp_path / "history.npz", data, [1])
    with np.load(tmp_path / "history.npz") as found:
        np.testing.assert_array_equal(found["value"], data["value"])


def test_an_exception_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with HistoryWriter(tmp_path / "history.npz", 2, 5) as writer:
            writer.add({name: array[:, :2] for name, array in arrays(2, 5).items()})
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_an_archive_that_is_not_closed_does_not_appear(tmp_path: Path) -> None:
    with HistoryWriter(tmp_path / "history.npz", 2, 5) as writer:
        writer.add(arrays(2, 5))
        assert not (tmp_path / "history.npz").exists()
    assert list(tmp_path.iterdir()) == []


def test_an_incomplete_archive_is_refused(tmp_path: Path) -> None:
    def cut_short() -> None:
        with HistoryWriter(tmp_path / "history.npz", 2, 5) as writer:
            writer.add({name: array[:, :4] for name, array in arrays(2, 5).items()})
            writer.close()

    with pytest.raises(AssertionError):
        cut_short()
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_does_not_exist_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        HistoryWriter(tmp_path / "nowhere" / "history.npz", 1, 1)


def test_an_archive_that_must_be_unpacked_is_refused_whatever_it_holds(tmp_path: Path) -> None:
    """Also an array that deflates to more bytes than it has: nothing is unpacked, ever."""
    for name, array in arrays(1, 5).items():
        np.savez_compressed(tmp_path / "history.npz", **{name: array})
        with pytest.raises(UnreadableError, match=f"{name} is compressed"):
            Archive(tmp_path / "history.npz")


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_row_is_read_alone_as_with_the_others(tmp_path: Path, order: str) -> None:
    expected = {name: np.asarray(array, order=order) for name, array in arrays(3, 5).items()}
    np.savez(tmp_path / "history.npz", **expected)
    archive = Archive(tmp_path / "history.npz")
    for name, array in expected.items():
        assert archive.shape(name) == array.shape
        np.testing.assert_array_equal(archive.read(name), array)
        for row in range(3):
            np.testing.assert_array_equal(archive.read(name, row), array[row])


@pytest.mark.parametrize("bit", range(16))
def test_an_archive_that_says_it_is_encrypted_is_refused(tmp_path: Path, bit: int) -> None:
    """The first bit of an entry's flags says so; the others say nothing that matters here."""
    path = tmp_path / "history.npz"
    np.savez(path, state=np.arange(4.0))
    whole = bytearray(path.read_bytes())
    listed = whole.index(b"PK\1\2")
    flags = int.from_bytes(whole[listed + 8 : listed + 10], "little") | 1 << bit
    whole[listed + 8 : listed + 10] = flags.to_bytes(2, "little")
    path.write_bytes(whole)
    if bit == 0:
        with pytest.raises(UnreadableError, match="state is compressed"):
            Archive(path)
    elif bit in (1, 2, 3):
        np.testing.assert_array_equal(Archive(path).read("state"), np.arange(4.0))


HIDDEN = {
    "a comment": lambda whole, said: whole[:-2] + len(said).to_bytes(2, "little") + said,
    "a comment that is cut off": lambda whole, said: (
        whole[:-2] + (len(said) + 9).to_bytes(2, "little") + said
    ),
    "bytes behind it": lambda whole, said: whole + said,
    "a comment announced": lambda whole, said: whole[:-2] + b"\1\0",
}


@pytest.mark.parametrize("how", HIDDEN)
@given(said=some.one_of(some.integers(1, 60).map(bytes), some.binary(min_size=1, max_size=60)))
def test_an_archive_whose_list_is_not_at_its_very_end_is_refused(
    tmp_path_factory: pytest.TempPathFactory, how: str, said: bytes
) -> None:
    """How long the list is would be read from somewhere else than `zipfile` reads it."""
    path = tmp_path_factory.mktemp("history") / "history.npz"
    np.savez(path, **arrays(1, 2))
    Archive(path)
    path.write_bytes(HIDDEN[how](path.read_bytes(), said))
    with pytest.raises(UnreadableError, match="does not end as an archive"):
        Archive(path)


@pytest.mark.parametrize(
    ("sign", "length", "before", "refused"),
    [
        (b"PK\6\6", 2**16, b"", False),
        (b"PK\6\6", 2**16 + 1, b"", True),
        (b"PK\6\6", 2**16 + 1, b"before", True),
        (b"PK\6\7", 2**16 + 1, b"", False),  # no such end: the other one counts
    ],
)
def test_the_list_of_a_large_archive_is_measured_by_its_second_end(
    sign: bytes, length: int, before: bytes, refused: bool
) -> None:
    """56 bytes of the end for large files, 20 that say where it is, and 22 of the end for small ones."""
    second = struct.pack("<4sQ2H2L4Q", sign, 44, 45, 45, 0, 0, 1, 1, length, 0)
    whole = before + second + bytes(20) + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, 50, 0, 0)
    if refused:
        with pytest.raises(ValueError, match=f"lists its arrays in {length} bytes"):
            _short_directory(io.BytesIO(whole), len(whole))
    else:
        _short_directory(io.BytesIO(whole), len(whole))
        for short in (22, 23, 60, 97):  # too short for a second end
            _short_directory(io.BytesIO(whole[-short:]), short)


def test_an_archive_may_be_empty_and_so_may_its_arrays(tmp_path: Path) -> None:
    path = tmp_path / "history.npz"
    zipfile.ZipFile(path, "w").close()
    assert path.stat().st_size == 22
    assert Archive(path).names == ()
    np.savez(path, one=np.array(2.5), none=np.zeros((0, 3)))
    archive = Archive(path)
    assert archive.read("one").shape == ()
    assert float(archive.read("one")) == 2.5
    assert archive.read("none").shape == (0, 3)
    for cut in (0, 21):
        path.write_bytes(path.read_bytes()[-cut:] if cut else b"")
        with pytest.raises(UnreadableError, match="cannot be read"):
            Archive(path)


def test_an_array_that_would_go_on_behind_the_file_is_refused(tmp_path: Path) -> None:
    path, held = tmp_path / "history.npz", io.BytesIO()
    np.lib.format.write_array_header_1_0(held, {"descr": "<f8", "fortran_order": False, "shape": (1000,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("state.npy", held.getvalue() + bytes(80))
    whole = bytearray(path.read_bytes())
    listed = whole.index(b"PK\1\2")
    said = struct.pack("<2L", *(len(held.getvalue()) + 8000,) * 2)
    whole[listed + 20 : listed + 28] = said  # packed and unpacked size, as the list has them
    path.write_bytes(whole)
    with pytest.raises(UnreadableError, match="state has another size than it says"):
        Archive(path)


def test_a_header_of_more_than_ten_thousand_bytes_is_not_read(tmp_path: Path) -> None:
    for blanks, taken in ((9000, True), (10_000, False)):
        text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }".ljust(blanks) + "\n"
        with zipfile.ZipFile(tmp_path / "history.npz", "w") as archive:
            head = b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text.encode()
            archive.writestr("a.npy", head + np.array([2.5]).tobytes())
        if taken:
            assert Archive(tmp_path / "history.npz").read("a").tolist() == [2.5]
        else:
            with pytest.raises(UnreadableError, match="cannot be read"):
                Archive(tmp_path / "history.npz")


def test_no_folder_between_a_run_and_its_archive_is_a_link(tmp_path: Path) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    for folder in (run / "deep", elsewhere):
        folder.mkdir(parents=True)
        np.savez(folder / "history.npz", a=np.arange(3.0))
    archive = Archive(run / "deep" / "history.npz", run)
    assert archive.read("a").tolist() == [0.0, 1.0, 2.0]
    (run / "deep").rename(tmp_path / "moved")
    (run / "deep").symlink_to(elsewhere)
    with pytest.raises(UnreadableError, match="a link, which is not followed"):
        archive.read("a")
    with pytest.raises(UnreadableError, match="a link, which is not followed"):
        Archive(run / "deep" / "history.npz", run)
    assert Archive(run / "deep" / "history.npz").read("a").tolist() == [0.0, 1.0, 2.0]
