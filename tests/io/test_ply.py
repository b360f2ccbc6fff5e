"""PLY files: what their headers declare fits into the file, and nothing is allocated before that is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bidnerf_core.io import read_ply
from refusals import refused

POINTS = np.array([[0.5, 1.0, -2.0], [3.0, 4.0, 5.0]], "<f4")


def ply(path: Path, *lines: str, form: str = "binary_little_endian", content: bytes = b"") -> Path:
    header = "\n".join(["ply", f"format {form} 1.0", *lines, "end_header", ""])
    path.write_bytes(header.encode() + content)
    return path


XYZ = [f"property float {axis}" for axis in "xyz"]


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_rows_are_read_in_every_form(tmp_path: Path, form: str) -> None:
    big = POINTS.astype(">f4").tobytes()
    text = "\n".join(" ".join(map(str, row)) for row in POINTS.tolist()).encode()
    content = {"ascii": text, "binary_big_endian": big}.get(form, POINTS.tobytes())
    path = ply(tmp_path / "a.ply", "comment two", "element vertex 2", *XYZ, form=form, content=content)
    found = read_ply(path)["vertex"]
    assert [[row[axis] for axis in "xyz"] for row in found] == POINTS.tolist()


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_an_element_without_properties_holds_nothing(tmp_path: Path, form: str) -> None:
    content = b"1 2 3\n" if form == "ascii" else POINTS[:1].tobytes()
    lines = ["element odd 0", "element vertex 1", *XYZ]
    assert len(read_ply(ply(tmp_path / "a.ply", *lines, form=form, content=content))["vertex"]) == 1
    path = ply(tmp_path / "b.ply", "element odd 5", *lines[1:], form=form, content=content)
    with refused(where=path, found="the elements 'odd' have no properties"):
        read_ply(path)


@pytest.mark.parametrize("count", ["3", "9" * 18, "9" * 4000])
@pytest.mark.parametrize("lists", [[], ["property list uchar int vertex_indices"]])
def test_more_elements_than_the_file_has_room_for_are_refused(tmp_path: Path, count: str, lists: list[str]) -> None:
    path = ply(tmp_path / "a.ply", *[f"element vertex {count}", *XYZ, *lists], content=POINTS.tobytes())
    with refused(where=path, found="is the file truncated?"):
        read_ply(path)


@pytest.mark.parametrize("line", ["element vertex -1", "element vertex " + "9" * 5000, "property float x", "noise"])
def test_a_line_of_the_header_that_means_nothing_is_named(tmp_path: Path, line: str) -> None:
    with refused(where=tmp_path / "a.ply", found=f"its header has the line {line[:60]!r}"):
        read_ply(ply(tmp_path / "a.ply", line))


@pytest.mark.parametrize("row", ["0 0 300", "0 0 -1", "0 a 1"])
def test_a_text_row_that_does_not_fit_its_properties_is_refused(tmp_path: Path, row: str) -> None:
    lines = ["element vertex 1", "property float x", "property float y", "property uchar red"]
    path = ply(tmp_path / "a.ply", *lines, form="ascii", content=row.encode())
    with refused(where=path, expected="1 rows of 3 numbers"):
        read_ply(path)


@pytest.mark.parametrize(("number", "is_byte"), [("255.0", True), ("0", True), ("256", False), ("0.5", False)])
def test_a_byte_in_a_text_may_be_written_as_a_float(tmp_path: Path, number: str, is_byte: bool) -> None:
    lines = ["element vertex 1", "property float x", "property uchar red"]
    path = ply(tmp_path / "a.ply", *lines, form="ascii", content=f"0.5 {number}\n".encode())
    if is_byte:
        assert read_ply(path)["vertex"].tolist() == [(0.5, float(number))]
    else:
        with refused(where=path, found="red is not of its type"):
            read_ply(path)
