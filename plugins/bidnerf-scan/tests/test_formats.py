"""Files of meshes and points: what is written is read, and damaged ones are refused with a sentence."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bidnerf_core.errors import InputError, InputWarning
from bidnerf_scan import importer, read_scan
from bidnerf_scan.scan import cleaned

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]])
BYTES = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [255, 255, 255, 255]], np.uint8)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def tetrahedron() -> trimesh.Trimesh:
    return trimesh.Trimesh(CORNERS, FACES, vertex_colors=BYTES, process=False)


def test_meshes_with_colours(tmp_path: Path) -> None:
    for ending in ("ply", "glb", "obj"):
        path = tmp_path / f"mesh.{ending}"
        tetrahedron().export(path)
        assert importer.recognises(path)
        scan = read_scan(path)
        assert np.allclose(scan.points[scan.faces], CORNERS[FACES], atol=1e-6)
        assert np.allclose(scan.rgb[scan.faces], BYTES[FACES][..., :3] / 255, atol=2e-3)


def test_a_mesh_that_countless_nodes_place_is_refused(tmp_path: Path) -> None:
    scene = trimesh.Scene({"box": trimesh.creation.box()})
    for number in range(19):
        scene.graph.update(frame_to=f"{number}", geometry="box")
    scene.export(tmp_path / "many.glb")
    with pytest.raises(InputError, match=r"many\.glb: its nodes place 160 points, expected at most 128"):
        read_scan(tmp_path / "many.glb")


def test_a_chain_of_countless_nodes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "chain.gltf").write_text(
        json.dumps({"asset": {"version": "2.0"}, "nodes": [{"children": [n + 1]} for n in range(5000)] + [{}]})
    )
    with pytest.raises(InputError, match="nodes below each other"):
        read_scan(tmp_path / "chain.gltf")


def test_no_file_outside_of_the_folder_is_opened(tmp_path: Path) -> None:
    inside = tmp_path / "scan"
    inside.mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (inside / "own.mtl").write_text("newmtl m\nKd 1 0 0\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n"
    for name, is_red in (("own.mtl", True), ("../secret.mtl", False), (str(tmp_path / "secret.mtl"), False)):
        (inside / "a.obj").write_text(f"mtllib {name}\n{corners}")
        rgb = read_scan(inside / "a.obj").rgb
        assert (rgb is not None and rgb[0].tolist() == [1, 0, 0]) == is_red


@pytest.mark.parametrize(
    ("libraries", "material", "fault"),
    [
        ("own.mtl", None, "own.mtl, its material or texture, is missing"),
        ("own.mtl", "map_Kd lost.png", "lost.png, its material or texture, is missing"),
        ("own.mtl", "\tmap_kd\tlost.png", "lost.png, its material or texture, is missing"),
        ("own.mtl", "map_Kd -clamp on lost.png", "lost.png, its material or texture, is missing"),
        ("own.mtl", "map_Kd -s 1 1 1 a.obj", "'-s 1 1 1 a.obj', several materials or a texture with options"),
        ("own.mtl b.mtl", "", "b.mtl, its material or texture, is missing"),
        ("own.mtl own.mtl", "", "'own.mtl own.mtl', several materials or a texture with options"),
    ],
)
def test_an_obj_without_its_material_has_no_colours(
    libraries: str, material: str | None, fault: str, tmp_path: Path
) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    (tmp_path / "a.obj").write_text(f"mtllib {libraries}\n{corners}")
    if material is not None:
        (tmp_path / "own.mtl").write_text(f"newmtl m\nKd 1 1 1\n{material}\n")
    with pytest.warns(InputWarning, match=f"a.obj: {fault}.*, so it is read without colours"):
        scan = read_scan(tmp_path / "a.obj")
    assert (scan.rgb, len(scan.images)) == (None, 0)


def test_a_gltf_is_placed_by_its_nodes(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for number in range(2):
        scene.add_geometry(tetrahedron(), transform=trimesh.transformations.translation_matrix([number, 0, 0]))
    scene.export(tmp_path / "two.glb")
    scan = read_scan(tmp_path / "two.glb")
    assert len(scan.faces) == 8
    assert scan.points.max(0) == pytest.approx([2, 2, 3])


def ply_of(points: np.ndarray, rgb: np.ndarray | None, text: bool) -> bytes:
    kind = [(axis, "<f4") for axis in "xyz"] + ([] if rgb is None else [(c, "u1") for c in "rgb"])
    rows = np.rec.fromarrays([*points.T, *([] if rgb is None else rgb.T)], dtype=np.dtype(kind))
    names = {"r": "red", "g": "green", "b": "blue"}
    lines = [
        "ply",
        f"format {'ascii' if text else 'binary_little_endian'} 1.0",
        f"element vertex {len(points)}",
    ]
    lines += [f"property {'float' if n in 'xyz' else 'uchar'} {names.get(n, n)}" for n, _ in kind] + [
        "end_header",
        "",
    ]
    body = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode() if text else rows.tobytes()
    return "\n".join(lines).encode() + body


def lzf_of(data: bytes) -> bytes:
    """Return LZF of literal runs and, where 40 bytes repeat those before, a copy."""
    found, at = b"", 0
    while at < len(data):
        if at >= 40 and data[at : at + 40] == data[at - 40 : at]:
            found += bytes([(7 << 5) | 0, 40 - 9, 39])
            at += 40
        else:
            run = data[at : at + 8]
            found += bytes([len(run) - 1]) + run
            at += len(run)
    return found


def pcd_of(points: np.ndarray, rgb: np.ndarray, data: str) -> bytes:
    packed = (rgb.astype(np.uint32) << [16, 8, 0]).sum(-1).astype(np.uint32)
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4")]
    rows = np.rec.fromarrays([*points.T, packed.view(np.float32)], dtype=np.dtype(kind))
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {data}\n"
    ).encode()
    if data == "binary":
        return head + rows.tobytes()
    if data == "ascii":
        return (
            head.replace(b"TYPE F F F F", b"TYPE F F F U")
            + "\n".join(
                f"{x} {y} {z} {c}" for (x, y, z), c in zip(points.tolist(), packed.tolist(), strict=True)
            ).encode()
        )
    columns = b"".join(rows[name].tobytes() for name in rows.dtype.names or ())
    small = lzf_of(columns)
    return head + struct.pack("<II", len(small), len(columns)) + small


def test_clouds(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    points = generator.normal(size=(30, 3)).astype(np.float32)
    points[10:] = 1.5  # which LZF compresses
    rgb = generator.integers(0, 256, (30, 3)).astype(np.uint8)
    files = {f"{t}.ply": ply_of(points, rgb, t) for t in (True, False)}
    files |= {f"{data}.pcd": pcd_of(points, rgb, data) for data in ("ascii", "binary", "binary_compressed")}
    files["v.obj"] = "\n".join(
        "v " + " ".join(map(str, [*p, *(c / 255)])) for p, c in zip(points.tolist(), rgb.astype(float), strict=True)
    ).encode()
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        scan = read_scan(tmp_path / name)
        assert scan.faces is None, name
        assert np.allclose(scan.points, points, atol=1e-6), name
        assert scan.rgb is not None, name
        assert np.allclose(scan.rgb, rgb / 255, atol=3e-3), name
    (tmp_path / "bare.ply").write_bytes(ply_of(points, None, False))
    assert not read_scan(tmp_path / "bare.ply").has_colours


def test_dark_colours_of_16_bits_stay_dark(tmp_path: Path) -> None:
    names = [f"float {axis}" for axis in "xyz"] + [f"ushort {colour}" for colour in ("red", "green", "blue")]
    head = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property {name}" for name in names),
        "end_header",
    ]
    rows = ["0 0 0 255 128 0", "1 0 0 0 0 0", "0 1 0 0 0 0"]
    (tmp_path / "dark.ply").write_text("\n".join([*head, *rows, ""]))
    rgb = read_scan(tmp_path / "dark.ply").rgb
    assert np.allclose(rgb, np.array([[255, 128, 0], [0, 0, 0], [0, 0, 0]]) / 65535, atol=1e-7)


def test_surveyors_formats(tmp_path: Path) -> None:
    points = np.array([[500000.25, 4200000.5, 100.125], [500001.0, 4200002.0, 101.0], [500003.0, 4200001.0, 99.0]])
    rgb = np.array([[65535, 0, 0], [0, 65535, 0], [0, 0, 65535]], np.uint16)
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets, header.scales = points.min(0), np.full(3, 0.001)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.red, cloud.green, cloud.blue = rgb.T
    cloud.write(tmp_path / "a.las")
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    columns = {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")}
    columns |= {f"color{c}": (rgb[:, i] >> 8).astype(np.uint8) for i, c in enumerate(("Red", "Green", "Blue"))}
    file.write_scan_raw(columns)
    file.close()
    for name in ("a.las", "a.e57"):
        scan = read_scan(tmp_path / name)
        assert np.allclose(scan.points, points, atol=1e-3), name
        assert np.allclose(scan.rgb, np.eye(3), atol=1e-6), name
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-40])
        with pytest.raises(InputError, match=name):
            read_scan(tmp_path / name)


def broken() -> dict[str, bytes]:
    points, rgb = np.random.default_rng(0).normal(size=(50, 3)), np.zeros((50, 3), np.uint8)
    cloud, pcd = ply_of(points, rgb, False), pcd_of(points, rgb, "binary")
    packed, text = pcd_of(points, rgb, "binary_compressed"), pcd_of(points, rgb, "ascii")
    mesh, glb = tetrahedron().export(file_type="ply"), tetrahedron().export(file_type="glb")
    many = b"1000000000000"
    return {
        "empty.ply": b"",
        "empty.obj": b"",
        "empty.glb": b"",
        "empty.pcd": b"",
        "empty.las": b"",
        "empty.e57": b"",
        "noise.ply": b"ply\n" + bytes(range(256)),
        "noise.glb": b"glTF" + bytes(range(256)),
        "noise.obj": bytes(range(256)),
        "noise.pcd": bytes(range(256)),
        "noise.las": bytes(range(256)),
        "cut.ply": cloud[:-100],
        "cut-mesh.ply": mesh[:-20],
        "cut.glb": glb[:-40],
        "cut.pcd": pcd[:-100],
        "cut-packed.pcd": packed[:-30],
        "cut-text.pcd": text[:-300],
        "many.ply": cloud.replace(b"vertex 50", b"vertex " + many),
        "many-vertices.ply": mesh.replace(b"vertex 4", b"vertex " + many),
        "many-faces.ply": mesh.replace(b"face 4", b"face " + many),
        "none.ply": cloud.replace(b"vertex 50", b"vertex 0"),
        "many.pcd": pcd.replace(b"POINTS 50", b"POINTS " + many),
        "many-packed.pcd": packed.replace(b"POINTS 50", b"POINTS " + many),
        "many-text.pcd": text.replace(b"POINTS 50", b"POINTS " + many),
        "wide.pcd": pcd.replace(b"COUNT 1 1 1 1", b"COUNT 1 1 1 " + many),
        "many.glb": with_count(glb, 10**12),
        "many-zeros.glb": with_count(glb, 10**12, zeros=True),
        "comment.obj": b"# nothing\n",
        "flat.obj": b"v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n",
    }


def with_count(glb: bytes, count: int, zeros: bool = False) -> bytes:
    """Return a glTF whose first accessor counts more than there is."""
    (length,) = struct.unpack("<I", glb[12:16])
    content = json.loads(glb[20 : 20 + length])
    content["accessors"][0]["count"] = count
    if zeros:
        del content["accessors"][0]["bufferView"]
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + length :]
    head = struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    """The refusal is one sentence that names the file, and comes before memory is asked for."""
    for name, content in broken().items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match=name):
            cleaned(read_scan(path), str(path))


def test_what_others_read_is_left_to_them(tmp_path: Path) -> None:
    (tmp_path / "splat.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nproperty float opacity\n"
        b"property float scale_0\nend_header\n"
    )
    (tmp_path / "splat.gltf").write_text('{"extensionsUsed": ["KHR_gaussian_splatting"]}')
    (tmp_path / "packed.gltf").write_text('{"extensionsUsed": ["KHR_draco_mesh_compression"]}')
    assert not importer.recognises(tmp_path / "splat.ply")
    assert not importer.recognises(tmp_path / "splat.gltf")
    assert not importer.recognises(tmp_path)
    with pytest.raises(InputError, match="draco"):
        read_scan(tmp_path / "packed.gltf")
