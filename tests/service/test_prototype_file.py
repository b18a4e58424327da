"""The prototype file: blocks are found after reopening, also after a crash."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.localise.venue.prototypes import ROW
from service.venues.prototype_file import BlockKey, PrototypeFile

LIMIT = 1000 * ROW.itemsize


def rows_of(seed: int, count: int) -> np.ndarray:
    return np.frombuffer(np.random.default_rng(seed).bytes(count * ROW.itemsize), ROW)


def key(number: int) -> BlockKey:
    return BlockKey(number, f"{number:064x}")


def opened(path: Path | None, *, cells_version: int = 7, limit_bytes: int = LIMIT) -> PrototypeFile:
    return PrototypeFile(path, cells_version=cells_version, limit_bytes=limit_bytes)


def content(file: PrototypeFile, number: int) -> bytes | None:
    found = file.find([key(number)])
    if not found:
        return None
    [(begin, count)] = found.values()
    return file.rows()[begin : begin + count].tobytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "folder" / "prototypes.bin"


def test_blocks_are_found_after_reopening(path: Path) -> None:
    file = opened(path)
    assert len(file.rows()) == 0
    file.add({key(1): rows_of(1, 5), key(2): rows_of(2, 9)})
    before = file.rows()
    file.add({key(3): rows_of(3, 1)})
    assert len(before) == 16
    assert file.rows().nbytes == path.stat().st_size == 18 * ROW.itemsize
    file.close()
    again = opened(path)
    for number, count in ((1, 5), (2, 9), (3, 1)):
        assert content(again, number) == rows_of(number, count).tobytes()
    assert again.find([BlockKey(1, f"{2:064x}"), BlockKey(4, f"{1:064x}")]) == {}
    again.close()
    # Sorted into cells of another version.
    assert opened(path, cells_version=8).find([key(1)]) == {}


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "torn rows": lambda whole: whole[:-1],
    "torn header": lambda whole: whole[: -9 * ROW.itemsize - 3],
    "zeros instead": lambda whole: whole[: 6 * ROW.itemsize] + bytes(10 * ROW.itemsize),
    "another byte": lambda whole: whole[:-5] + bytes([whole[-5] ^ 1]) + whole[-4:],
    "another header": lambda whole: whole[: 6 * ROW.itemsize + 9] + b"\xff" + whole[6 * ROW.itemsize + 10 :],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_damaged_end_is_truncated(path: Path, damage: Callable[[bytes], bytes]) -> None:
    file = opened(path)
    file.add({key(1): rows_of(1, 5)})
    file.add({key(2): rows_of(2, 9)})
    file.close()
    path.write_bytes(damage(path.read_bytes()))
    file = opened(path)
    assert content(file, 1) == rows_of(1, 5).tobytes()
    assert content(file, 2) is None
    file.add({key(2): rows_of(2, 9)})
    file.close()
    assert content(opened(path), 2) == rows_of(2, 9).tobytes()


def test_full_file_is_replaced_and_maps_stay_valid(path: Path) -> None:
    file = opened(path, limit_bytes=20 * ROW.itemsize)
    file.add({key(1): rows_of(1, 12)})
    begin, count = file.find([key(1)])[key(1)]
    in_work = file.rows()
    file.add({key(2): rows_of(2, 15)})
    assert content(file, 1) is None
    assert content(file, 2) == rows_of(2, 15).tobytes()
    assert in_work[begin : begin + count].tobytes() == rows_of(1, 12).tobytes()
    # Larger than the limit of the file.
    file.add({key(3): rows_of(3, 20)})
    assert content(file, 3) is None
    assert content(file, 2) is not None
    assert file.rows().nbytes <= 20 * ROW.itemsize
    file.close()
    assert content(opened(path), 2) == rows_of(2, 15).tobytes()


def test_second_process_and_no_path_get_their_own_file(path: Path) -> None:
    first = opened(path)
    first.add({key(1): rows_of(1, 5)})
    second = opened(path)
    assert content(second, 1) is None
    second.add({key(2): rows_of(2, 5)})
    assert content(second, 2) == rows_of(2, 5).tobytes()
    assert path.stat().st_size == 6 * ROW.itemsize
    second.close()
    first.close()
    file = opened(None)
    file.add({key(1): rows_of(1, 5)})
    assert content(file, 1) == rows_of(1, 5).tobytes()
    file.close()
