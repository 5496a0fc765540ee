"""Limits of what is taken from files of unknown origin: what just fits is taken, one more is not."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from staf_torch.results.archive import Archive
from staf_torch.results.settings_file import SettingsFile, read_settings
from staf_torch.results.untrusted import UnreadableError
from staf_torch.settings.trust import checked

DEPTH, NODES = 30, 20_000


def settings_of(tree: Any) -> dict[str, Any]:
    return checked(SettingsFile(tree, {}, [""]), "config.yaml")


def nested(depth: int) -> dict[str, Any]:
    tree: dict[str, Any] = {"leaf": 1}
    for _ in range(depth - 1):
        tree = {"in": tree}
    return tree


FITS = {  # what just fits and what does not, and the reason that is given
    "entries of a list": ({"a": [1] * 1000}, {"a": [1] * 1001}, "lists 1001 entries, and 1000 are the most"),
    "characters of a text": ({"a": "x" * 1000}, {"a": "x" * 1001}, "a text of 1001 characters, and 1000"),
    "a count": ({"count": 1000}, {"count": 1001}, "asks for 1001, and 1000 is the most"),
    "a count below zero": ({"count": -1000}, {"count": -1001}, "asks for -1001"),
    "trajectories": ({"trajectories": 10**6}, {"trajectories": 10**6 + 1}, "and 1e.06 is the most"),
    "inner steps": ({"inner_steps": 10**6}, {"inner_steps": 10**6 + 1}, "and 1e.06 is the most"),
    "record_every": ({"record_every": 10**6}, {"record_every": 10**6 + 1}, "and 1e.06 is the most"),
    "steps": ({"duration": 1e7, "dt": 1.0}, {"duration": 1.1e7, "dt": 1.0}, "1.1e.07 steps, and 1e.07"),
    "steps back in time": ({"duration": -1e7, "dt": 1}, {"duration": -1.1e7, "dt": 1}, "1.1e.07 steps"),
    "depth": (nested(DEPTH), nested(DEPTH + 1), "grows without end"),
    "nodes": (
        {str(each): [0] * 999 for each in range(19)} | {"rest": [0] * (NODES - 19_000 - 2)},
        {str(each): [0] * 999 for each in range(19)} | {"rest": [0] * (NODES - 19_000 - 1)},
        "grows without end",
    ),
}


@pytest.mark.parametrize("name", FITS)
def test_what_just_fits_is_taken_and_one_more_is_refused(name: str) -> None:
    fits, too_large, why = FITS[name]
    assert settings_of(fits) == fits
    with pytest.raises(ValueError, match=why):
        settings_of(too_large)


@pytest.mark.parametrize("tree", [{"seed": 10**12}, {"duration": 1e9}, {"settle_time": 10**9}, {"gain": 1e9}])
def test_a_seed_a_time_and_a_gain_may_be_of_any_size(tree: dict[str, Any]) -> None:
    assert settings_of(tree) == tree


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_no_seed_and_no_count_is_beyond_every_number(value: float) -> None:
    if value != value:
        with pytest.raises(ValueError, match="asks for nan"):
            settings_of({"gain": value})
    with pytest.raises(ValueError, match="asks for"):
        settings_of({"trajectories": value})


def test_truth_values_are_no_numbers_and_references_are_followed() -> None:
    tree = {"a": {"b": "${c}"}, "c": "${d.0x}", "d": {"0x": True}, "list": ["${c}"]}
    assert settings_of(tree) == {"a": {"b": True}, "c": True, "d": {"0x": True}, "list": [True]}


@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"a": "${a}"}, "grows without end"),
        ({"a": "${b}"}, "refers to b, which there is not"),
        ({"a": {"b": 1}, "c": "${a.b.d}"}, "refers to a.b.d, which there is not"),
        ({"a": "${oc.env:HOME}"}, "no plain reference"),
        ({"a": "1${b}", "b": 1}, "no plain reference"),
        ({"${b}": 1, "b": 2}, "has an interpolation for a name"),
        ({"_set_": 1}, "has _set_, which the library never writes"),
        ({"a": {"_target_": "os.system"}}, "names 'os.system'"),
        ([1, 2], "must be settings by name"),
        ("text", "must be settings by name"),
    ],
)
def test_what_settings_hide_is_refused(tree: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        settings_of(tree)


# YAML


def read(folder: Path, text: str) -> Any:
    (folder / "config.yaml").write_text(text)
    return read_settings(folder / "config.yaml", folder).tree


def test_a_file_is_nested_and_long_up_to_its_limit(tmp_path: Path) -> None:
    assert read(tmp_path, "[" * DEPTH + "]" * DEPTH) is not None
    with pytest.raises(UnreadableError, match=r"config.yaml:1 is nested too deep, or too long"):
        read(tmp_path, "[" * (DEPTH + 1) + "]" * (DEPTH + 1))
    # start of stream, of document and of the list come before the entries
    assert len(read(tmp_path, "[" + "1," * (NODES - 6) + "1]")) == NODES - 5
    with pytest.raises(UnreadableError, match="too long"):
        read(tmp_path, "[" + "1," * (NODES + 1) + "1]")


def test_siblings_are_not_deep(tmp_path: Path) -> None:
    assert read(tmp_path, "[" + "[1]," * (2 * DEPTH) + "[1]]") == [[1]] * (2 * DEPTH + 1)


def test_a_file_of_a_quarter_of_a_megabyte_is_read_and_a_larger_one_is_not(tmp_path: Path) -> None:
    assert read(tmp_path, "a: 1\n#" + "x" * (2**18 - 6)) == {"a": 1}
    with pytest.raises(UnreadableError):
        read(tmp_path, "a: 1\n#" + "x" * (2**18 - 5))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("-2.5E+4", -2.5e4),
        ("1.", 1.0),
        ("9223372036854775807", 2**63 - 1),
        ("9223372036854775808", float(2**63)),
        ("-9223372036854775808", -float(2**63)),
        ("1" + "0" * 300, float("inf")),
        ("9" * 300, 1e300),
        ("2026-11-24", "2026-11-24"),
        ("yes", True),
        ("~", None),
        ("'1e-3'", "1e-3"),
    ],
)
def test_plain_values_are_what_hydra_reads(text: str, value: object, tmp_path: Path) -> None:
    found = read(tmp_path, f"a: {text}")["a"]
    assert type(found) is type(value)
    assert found == value


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a: &x 1\nb: *x", "config.yaml:1 has an anchor or an alias"),
        ("b: 1\na: !!python/name:os.system x", "line 2 has the tag"),
        ("a: 1\nb: 2\na: 3", "line 3 has a key twice"),
        ("a: 1\n? [b]\n: 2", "line 2 has a key twice, or one that is no text"),
        ("a: [1", "config.yaml is not YAML"),
    ],
)
def test_what_hydra_never_writes_is_refused_with_its_line(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(UnreadableError, match=why):
        read(tmp_path, text)


def test_the_line_of_a_key_is_its_own_or_the_nearest_above(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("kernel:\n  width: 2\nlist:\n - a: 1\n - b: 2\n")
    found = read_settings(tmp_path / "config.yaml", tmp_path)
    assert found.line("kernel") == "1: kernel:"
    assert found.line("kernel.width") == "2: width: 2"
    assert found.line("kernel.width.more") == "2: width: 2"
    assert found.line("list.1.b") == "5: - b: 2"
    assert found.line("other") == "1: kernel:"
    (tmp_path / "config.yaml").write_text("")
    assert read_settings(tmp_path / "config.yaml", tmp_path).line("a") == "1: "


# Archives


def saved(path: Path, **arrays: np.ndarray) -> bytes:
    np.savez(path, **arrays)
    return path.read_bytes()


def test_the_list_of_an_archive_may_have_64_kilobytes(tmp_path: Path) -> None:
    path = tmp_path / "history.npz"
    with zipfile.ZipFile(path, "w") as archive:
        names = [f"{each:04d}".ljust(200, "x") for each in range(265)]
        for name in names:
            archive.writestr(f"{name}.npy", npy(np.arange(2.0)))
    whole = path.read_bytes()
    length = struct.unpack("<4s4H2LH", whole[-22:])[5]
    assert length == 265 * (46 + 204) > 2**16
    with pytest.raises(UnreadableError, match=f"lists its arrays in {length} bytes"):
        Archive(path)
    with zipfile.ZipFile(path, "w") as archive:
        for name in names[:261]:
            archive.writestr(f"{name}.npy", npy(np.arange(2.0)))
        archive.writestr("y" * (2**16 - 261 * 250 - 46 - 4) + ".npy", npy(np.arange(3.0)))
    assert struct.unpack("<4s4H2LH", path.read_bytes()[-22:])[5] == 2**16
    assert len(Archive(path).names) == 262


def npy(array: np.ndarray) -> bytes:
    import io

    made = io.BytesIO()
    np.save(made, array)
    return made.getvalue()


@pytest.mark.parametrize(
    ("array", "taken"),
    [
        (np.array([True, False]), True),
        (np.arange(3, dtype=np.uint8), True),
        (np.array(["a", "bc"]), True),
        (np.zeros((0, 3)), True),
        (np.array(2.5), True),
        (np.array([1 + 2j]), False),
        (np.array([b"ab"]), False),
        (np.array(["2026-11-24"], dtype="datetime64[D]"), False),
        (np.zeros(2, dtype=[("a", "f8")]), False),
    ],
)
def test_numbers_and_texts_are_arrays_and_nothing_else_is(
    array: np.ndarray, taken: bool, tmp_path: Path
) -> None:
    saved(tmp_path / "history.npz", state=array)
    if taken:
        found = Archive(tmp_path / "history.npz").read("state")
        assert found.dtype == array.dtype
        np.testing.assert_array_equal(found, array)
    else:
        with pytest.raises(UnreadableError, match="state holds no numbers"):
            Archive(tmp_path / "history.npz")


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_every_version_of_the_header_is_read(version: tuple[int, int], tmp_path: Path) -> None:
    import io

    made = io.BytesIO()
    np.lib.format.write_array(made, np.arange(6.0).reshape(2, 3), version=version)
    with zipfile.ZipFile(tmp_path / "history.npz", "w") as archive:
        archive.writestr("state.npy", made.getvalue())
    np.testing.assert_array_equal(
        Archive(tmp_path / "history.npz").read("state", 1), np.array([3.0, 4.0, 5.0])
    )


@pytest.mark.parametrize("said", [(2, 4), (2, 2), (-2, -3), (3, 3)])
def test_an_array_that_says_another_shape_than_it_has_is_refused(
    said: tuple[int, ...], tmp_path: Path
) -> None:
    path = tmp_path / "history.npz"
    whole = saved(path, state=np.arange(6.0).reshape(2, 3))
    changed = whole.replace(b"(2, 3), }" + b" " * 4, f"{said}, }}".encode().ljust(13))
    assert changed != whole
    path.write_bytes(changed)
    with pytest.raises(UnreadableError):
        Archive(path)


def test_an_array_that_is_cut_off_later_is_named(tmp_path: Path) -> None:
    path = tmp_path / "history.npz"
    whole = saved(path, first=np.arange(6.0), last=np.arange(9.0))
    archive = Archive(path)
    path.write_bytes(whole[: whole.index(b"last") + 60])
    np.testing.assert_array_equal(archive.read("first"), np.arange(6.0))
    with pytest.raises(UnreadableError, match="last is cut off"):
        archive.read("last")


def test_a_name_that_is_not_there_says_which_are(tmp_path: Path) -> None:
    saved(tmp_path / "history.npz", first=np.arange(6.0), last=np.arange(9.0))
    for act in (Archive.shape, Archive.read):
        with pytest.raises(KeyError, match=r"'middle' is not in .*; there are first, last"):
            act(Archive(tmp_path / "history.npz"), "middle")
